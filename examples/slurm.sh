#!/usr/bin/env bash
# A data set by an array of jobs that know nothing of each other: sbatch examples/slurm.sh organ.toml
# Each solves every SLURM_ARRAY_TASK_COUNT-th block; any of them may be killed, or started again, at any time. After the
# last, `softtwin generate organ.toml` makes the blocks that are missing, and the Jacobians. Without SLURM it is one job.
#SBATCH --job-name=softtwin
#SBATCH --array=0-15
#SBATCH --ntasks=1
#SBATCH --cpus-per-task=1
#SBATCH --time=04:00:00
set -euo pipefail
export OPENBLAS_NUM_THREADS=1
softtwin generate "${1:?organ.toml}" --part "${SLURM_ARRAY_TASK_ID:-0}/${SLURM_ARRAY_TASK_COUNT:-1}"
