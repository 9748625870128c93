# Read by start.sh and stop.sh.
STATE=/run/stereotruth-slurm # daemons' state, logs and the munge key
NODES="n1 n2 n3"
LINK=/etc/slurm/slurm.conf
