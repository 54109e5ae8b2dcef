"""End-effector trajectories that others recorded, as sources of moving targets."""
