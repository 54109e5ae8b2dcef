#!/usr/bin/env bash
# Freezes, verifies and uses a protocol of your own: examples/own_protocol/run.sh [FOLDER], ten seconds on one core.
set -euo pipefail
folder=${1:-build/own_protocol}
mkdir -p "$folder"
cp "$(dirname "$0")/near.toml" "$folder"

# Draws the episodes: near.parquet and its hash near.sha256 stand beside the protocol from now on.
wbc-bench protocol freeze "$folder/near.toml"
# Hash, counts, ranges, and the feasibility of a sample.
wbc-bench protocol verify "$folder/near.toml"
# Every controller meets these same eight episodes.
wbc-bench eval --controller hold ik --protocol "$folder/near.toml" --out "$folder"
