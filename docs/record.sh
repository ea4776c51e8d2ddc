#!/usr/bin/env bash
# record.sh FLEET.toml: what only the hardware can tell, into a folder beside the file.
# Each part is written though a robot is off or something is wrong with it.
set -uo pipefail
export LPAC_FLEET=${1:?"record.sh FLEET.toml"}
day=$(dirname "$LPAC_FLEET")/record-$(date +%Y%m%d-%H%M%S)
mkdir -p "$day" || exit

lpac fleet doctor --laptop --json > "$day/laptop.json"
lpac fleet doctor --json > "$day/doctor.json"
lpac fleet status --json > "$day/status.json"
lpac fleet exec --json 'uname -a; systemctl --version | head -n 1; python3 --version
    rsync --version | head -n 1; docker --version; dpkg -l | grep -i voxl; lscpu; ls /data/px4/log
    for zone in /sys/class/thermal/thermal_zone*; do cat "$zone/type" "$zone/temp"; done' \
    > "$day/system.json"
lpac fleet exec --json \
    'systemctl show lpac-robot -p MemoryCurrent,CPUUsageNSec,NRestarts,TasksCurrent' \
    > "$day/unit.json"
lpac fleet pull --out "$day/trials"
echo "$day"
