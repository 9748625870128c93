#!/usr/bin/env bash
# Snakemake goes by the times of input files whether the trigger "mtime" is given or not.
#
# Guess: "--rerun-triggers params" leaves times of files out of account, and "--rerun-triggers mtime"
#   reruns what is older than its input: "the traditional way of just considering file modification
#   dates", as the help text has it.
# What happens: neither. Input of 1 MB and more that is touched makes its job due with the triggers
#   "params", "code" or any other. Smaller input that is touched makes nothing due, not even with
#   "mtime", since its checksum is compared. "params" itself is heeded; ancient() keeps times out.
# Source: snakemake 9.27.1, dag.py: updated_input asks for times and checksums without a look at the
#   triggers, and RerunTrigger.MTIME is read nowhere. Issues 2011 and 3095 and pull request 3690 of
#   snakemake/snakemake tell of the second half. The limit is --max-checksum-file-size.
# Why it matters: images and LiDAR are above that limit, and a copy or a download renews their times.
#   Who leaves "mtime" out, so that labels are made again only where code or settings changed, has
#   the labels of all scenes made again after the data moved to another disk.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check snakemake==9.27.1
export PATH="$folder/venv/bin:$PATH" HOME="$folder"
cat > Snakefile <<'SNAKEFILE'
rule labels:
    input: ancient("points.laz") if config.get("ancient") else "points.laz"
    output: "labels.tif"
    params: cell=config.get("cell", 1)
    shell: "wc -c < {input} > {output}"
SNAKEFILE

make() {  # size of the input in bytes: makes the labels, then touches the input
    head -c "$1" /dev/zero > points.laz
    snakemake --quiet all --cores 1 --forceall > log 2>&1 || { cat log; exit 1; }
    sleep 1.1
    touch points.laz
}

plan() {  # text that the plan must hold, arguments of Snakemake
    local expected=$1
    shift
    snakemake --dry-run --cores 1 "$@" > log 2>&1 || { cat log; exit 1; }
    printf '  %-48s' "$*"
    grep -o -m 1 -e "$expected" log || { echo "not as described:"; cat log; exit 1; }
}

echo "snakemake $(snakemake --version)"
echo "2 MB, touched"
make 2000000
plan "Updated input files: points.laz" --rerun-triggers params
plan "Updated input files: points.laz" --rerun-triggers code
plan "Updated input files: points.laz" --rerun-triggers params code input software-env
plan "Nothing to be done" --rerun-triggers params --config ancient=1
echo "2 kB, touched"
make 2000
plan "Nothing to be done" --rerun-triggers mtime
plan "Nothing to be done" --rerun-triggers mtime --config cell=2
plan "Params have changed" --rerun-triggers params --config cell=2
