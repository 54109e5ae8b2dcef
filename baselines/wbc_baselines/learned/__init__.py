"""The learned family: policies with a context estimator, their training, checkpoints and export."""
