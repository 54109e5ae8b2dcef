"""Where training's physics runs; one interface, one model."""
