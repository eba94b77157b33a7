#!/bin/bash
# Completes the scenes of a manifest in an array of SLURM, 100 tasks that share one folder:
#
#     sbatch examples/05_batch_on_slurm.sh manifest.csv results
#
# Send it again after whatever stopped it: what has a row is left, the rest goes on.
#SBATCH --job-name=gscompleter
#SBATCH --array=0-99
#SBATCH --cpus-per-task=4
#SBATCH --mem=8G
#SBATCH --time=04:00:00
#SBATCH --requeue
#SBATCH --signal=B:TERM@60

# A minute before the time is over the workers are stopped, and remove what is unfinished.
trap 'kill -TERM "$worker"; wait "$worker"' TERM
gscompleter batch "$1" --out "$2" --shard auto --workers 2 --threads 2 &
worker=$!
wait "$worker"
