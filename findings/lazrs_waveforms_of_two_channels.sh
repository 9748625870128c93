#!/usr/bin/env bash
# lazrs writes wrong places of waveforms for LiDAR of more than one scanner channel.
#
# Guess: LAZ is lossless. A file of point format 9 (or 10) that laspy writes by lazrs, its default, has all
#   fields as they were, as one that it writes by LASzip does.
# What happens: where points have two scanner channels, the waveform's place in its file and the place of
#   the return within it are other numbers from the first change of channel on: for 75 % of the points
#   where the channel changes after each quarter of them. All other fields are right, and so is all with
#   one channel. lazrs and LASzip read the same wrong numbers; what LASzip writes both read right.
# Source: laspy 2.7.0 with lazrs 0.8.2, laszip 0.3.0 (LASzip 3.5.0); LAZ 1.4 keeps a state for each of
#   four channels.
# Why it matters: scanners with two channels are what airborne LiDAR with waveforms comes from. Echoes
#   are found again in the waveforms where pulses go through crowns or meet edges of roofs, to get the
#   density that truth needs. After a compression each point has the waveform of another pulse.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check \
    laspy==2.7.0 lazrs==0.8.2 laszip==0.3.0 numpy==2.2.6
venv/bin/python - <<'PYTHON'
from importlib.metadata import version

import laspy
import numpy as np

BACKENDS = {"lazrs": laspy.LazBackend.Lazrs, "LASzip": laspy.LazBackend.Laszip}
print("laspy", laspy.__version__, "lazrs", version("lazrs"), "laszip", version("laszip"))
number, rng = np.arange(2000), np.random.default_rng(0)


def changed(writer, channels):
    """Shares of points whose fields are not what was written, by reader."""
    points = laspy.LasData(laspy.LasHeader(point_format=9, version="1.4"))
    points.x, points.y, points.z = number * 0.5, rng.uniform(0, 100, 2000), rng.uniform(0, 5, 2000)
    points.gps_time = number * 1e-5
    points.return_number = points.number_of_returns = points.wavepacket_index = np.ones(2000, int)
    points.scanner_channel = number // 500 % channels
    points.wavepacket_offset, points.wavepacket_size = 60 + 256 * number, np.full(2000, 256)
    points.return_point_wave_location = rng.uniform(0, 1000, 2000)
    points.x_t, points.y_t, points.z_t = (np.full(2000, step) for step in (1e-4, 2e-5, -1.5e-4))
    points.write("points.laz", laz_backend=BACKENDS[writer])
    found = {}
    for reader, backend in BACKENDS.items():
        read = laspy.read("points.laz", laz_backend=backend).points.array
        shares = {name: float(np.mean(read[name] != points.points.array[name])) for name in read.dtype.names}
        found[reader] = {name: round(share, 2) for name, share in shares.items() if share}
    return found


for writer in BACKENDS:
    for channels in (1, 2):
        found = changed(writer, channels)
        print(f"{channels} channel(s), written by {writer}; changed as read by", found)
        if writer == "lazrs" and channels == 2:
            wrong = {"wavepacket_offset": 0.75, "return_point_wave_location": 0.75}
            assert found == {"lazrs": wrong, "LASzip": wrong}
        else:
            assert found == {"lazrs": {}, "LASzip": {}}
PYTHON
