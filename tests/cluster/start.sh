#!/usr/bin/env bash
# Starts munged, slurmctld and three slurmd on 127.0.0.1; waits until all nodes are idle.
# Installs Debian's packages if they are missing. Root only. All files lie in one folder, but for
# the link /etc/slurm/slurm.conf: srun finds its controller only there once the SLURM plugin's
# job step has dropped every SLURM_* variable.
# Exit status: 75 if this machine cannot run it (not root, no Debian packages), 1 for failures.
set -euo pipefail
cd "$(dirname "$0")"
source settings.sh

skip() {
  echo "no cluster test: $1" >&2
  exit 75
}

[ "$(id -u)" = 0 ] || skip "it needs root"
if [ -e "$STATE" ]; then
  echo "$STATE exists: run tests/cluster/stop.sh first" >&2
  exit 1
fi
[ ! -e "$LINK" ] && [ ! -L "$LINK" ] || skip "$LINK is another cluster's, which is left alone"
if ! command -v slurmctld slurmd munged > /dev/null; then
  command -v apt-get > /dev/null || skip "SLURM is not installed, and there is no apt-get"
  echo "installing slurm-wlm and munge"
  export DEBIAN_FRONTEND=noninteractive
  { apt-get update && apt-get install --yes --no-install-recommends slurm-wlm munge; } \
    > /dev/null 2>&1 || skip "apt-get cannot install slurm-wlm and munge"
fi

install --directory --mode=755 "$STATE" "$STATE/controller"
for node in $NODES; do
  install --directory --mode=755 "$STATE/$node"
done
trap ./stop.sh ERR
head --bytes=1024 /dev/urandom > "$STATE/munge.key"
chmod 600 "$STATE/munge.key"
munged --force --key-file="$STATE/munge.key" --socket="$STATE/munge.socket" \
  --pid-file="$STATE/munged.pid" --log-file="$STATE/munged.log" --seed-file="$STATE/munge.seed"
sed -e "s|@HOST@|$(hostname --short)|" -e "s|@STATE@|$STATE|" slurm.conf.in > "$STATE/slurm.conf"
mkdir --parents "$(dirname "$LINK")"
ln --symbolic "$STATE/slurm.conf" "$LINK"
slurmctld
for node in $NODES; do
  slurmd -N "$node"
done
for _ in $(seq 100); do
  [ "$(sinfo --noheader --Node --format=%t 2> "$STATE/sinfo.err")" = $'idle\nidle\nidle' ] && exit 0
  sleep 0.2
done
tail --lines=20 "$STATE"/*.log "$STATE/sinfo.err" >&2
false
