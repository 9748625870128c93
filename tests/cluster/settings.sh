# Read by start.sh and stop.sh.
STATE=/run/stereotruth-slurm # daemons' state, logs and the munge key
LINK=/etc/slurm/slurm.conf
