#!/usr/bin/env bash
# Starts the cluster, runs the test on it, stops it. Exit status: 75 if this machine cannot.
set -euo pipefail
cd "$(dirname "$0")/../.."
tests/cluster/start.sh
trap tests/cluster/stop.sh EXIT
TEST_CLUSTER=1 timeout --kill-after=30 900 pytest tests/cluster
