"""A diffusion policy as a source of targets: it pushes doors shut. README.md tells the parts."""
