#!/usr/bin/env bash
# A data set by an array of jobs that know nothing of each other: sbatch examples/slurm.sh organ.toml
# Each solves every PARTS-th block; any of them may be killed, or started again, at any time: a lost one alone by
# sbatch --array=3 examples/slurm.sh organ.toml. After the last, `softtwin generate organ.toml` makes the blocks that
# are missing, and the Jacobians. Without SLURM it is one job. For another number of parts change both lines:
# SOFTTWIN_PARTS=8 sbatch --array=0-7 examples/slurm.sh organ.toml
#SBATCH --job-name=softtwin
#SBATCH --array=0-15
#SBATCH --ntasks=1
#SBATCH --cpus-per-task=1
#SBATCH --time=04:00:00
set -euo pipefail
export OPENBLAS_NUM_THREADS=1
PARTS=${SOFTTWIN_PARTS:-16} # not SLURM_ARRAY_TASK_COUNT: that is 1 where one task is made again
if [ -z "${SLURM_ARRAY_TASK_ID:-}" ]; then
    SLURM_ARRAY_TASK_ID=0 PARTS=1
fi
softtwin generate "${1:?organ.toml}" --shard "$SLURM_ARRAY_TASK_ID/$PARTS"
