#!/usr/bin/env bash
# Ends all jobs and daemons that start.sh has started and removes their files. A second call does
# nothing.
set -uo pipefail
cd "$(dirname "$0")"
source settings.sh

[ -e "$STATE" ] || exit 0

running() { # PID: neither gone nor a zombie (where process 1 does not reap)
  case "$(ps --format stat= --pid "$1" 2> /dev/null)" in "" | Z*) return 1 ;; esac
}

if [ "$(readlink "$LINK")" = "$STATE/slurm.conf" ]; then
  timeout 10 scancel --partition=main 2> /dev/null
  for _ in $(seq 50); do
    [ -z "$(timeout 10 squeue --noheader 2> /dev/null)" ] && break
    sleep 0.2
  done
fi
left=0
for name in $NODES slurmctld munged; do
  [ -s "$STATE/$name.pid" ] || continue
  pid=$(cat "$STATE/$name.pid")
  kill "$pid" 2> /dev/null
  for _ in $(seq 100); do
    running "$pid" || break
    sleep 0.1
  done
  running "$pid" && echo "$name (process $pid) did not end" >&2 && left=1
done
[ "$(readlink "$LINK")" = "$STATE/slurm.conf" ] && rm "$LINK"
[ $left = 0 ] && rm -r "$STATE"
exit $left
