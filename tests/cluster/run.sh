#!/usr/bin/env bash
# Starts the cluster, runs the test on it, stops it. Exit status: 75 if this machine cannot.
set -euo pipefail
cd "$(dirname "$0")/../.."
tests/cluster/start.sh
trap tests/cluster/stop.sh EXIT
# KILL, since a Snakemake that is asked to end waits for the answers of a cluster
TEST_CLUSTER=1 timeout --signal=KILL 2400 pytest --durations=10 tests/cluster
