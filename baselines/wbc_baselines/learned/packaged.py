"""Where the files that ship with the learned controllers are; importing it needs no package of theirs."""

from pathlib import Path

CHECKPOINTS = Path(__file__).with_name("checkpoints")  # ROBOT/METHOD@SEED.safetensors and .json
RECIPES = Path(__file__).with_name("recipes")  # NAME.toml
TARGET_SETS = Path(__file__).with_name("target_sets")  # PROTOCOL.parquet
