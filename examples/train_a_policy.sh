#!/usr/bin/env bash
# Trains a policy for half a minute on one core, then evaluates its checkpoint: examples/train_a_policy.sh [FOLDER]
# It shows the way, not a good policy: those that ship had a thousand times as many control steps (docs/training.md).
set -euo pipefail
folder=${1:-build/train_a_policy}
budget=${BUDGET:-80e3}    # control steps
episodes=${EPISODES:-20}  # of the evaluation

# 64 environments x 24 control steps per update, one thread. The policy starts with the weights of the shipped oracle and
# imitates it in the first half (--distillation-steps); then PPO goes on. The same command resumes an interrupted run.
wbc-train run --method no_latent --seed 0 --budget "$budget" --num-envs 64 --threads 1 \
  --distillation-steps 40e3 --kickstart-steps 80e3 --std-legs 0 0.1 80e3 0.05 --std-arm 0 0.1 80e3 0.05 \
  --out "$folder/runs"
wbc-train status --out "$folder/runs"

# A trained policy is a controller like any other.
wbc-bench eval --controller "learned:$folder/runs/no_latent@0/no_latent@0.safetensors" \
  --protocol nominal_v1 --replicates 1 --episodes "$episodes" --workers 1 --out "$folder/results"
