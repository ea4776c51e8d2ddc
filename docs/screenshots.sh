#!/usr/bin/env bash
# docs/watch.png, docs/map.png, docs/report.png: ten robot programs in the simulator, commanded,
# seen and reported as in the field. Called by `make screenshots`; needs chromium.
set -euo pipefail
cd "$(dirname "$0")/.."
out=out/screenshots
export LPAC_FLEET="$out/fleet.toml"
command -v chromium > /dev/null || { echo 'needs: sudo apt install chromium' >&2; exit 1; }

rm -rf "$out"
mkdir -p "$out"
# Each is ended as by Ctrl-C, which a background program of a script would not see.
trap 'jobs -p | xargs -r kill; wait' EXIT
lpac sim --vehicle mavlink -n 10 --seed 3 --no-script --out "$out" &> "$out/sim.log" &
until grep -q 'lpac ground' "$out/sim.log"; do kill -0 $!; sleep 0.2; done
lpac ground --name alice@laptop &> "$out/ground.log" &
until lpac watch --once &> /dev/null; do kill -0 $!; sleep 0.2; done
lpac record &> "$out/record.log" &
lpac map --port 0 > "$out/map.log" &

lpac mission origin 39.9526 -75.1652 30
lpac mission enable
# Patient, and begun before the flight: the robots' programs fly in real time.
address=$(grep -o 'http://[^ ]*' "$out/map.log")
nice python -m tests.process.ground.browser "$address" docs/map.png --wait 55 &
page=$!
lpac mission takeoff --yes --interval 1
lpac mission start
sleep 15
nice lpac watch --screenshot "$out/watch.svg" --size 118x24
wait $page
sleep 10
lpac mission return --wait
lpac report "$out" --times 0,10,20,40
cp "$out"/report/*/snapshots.png docs/report.png

read -r width height < <(sed -nE '1,2s/.*viewBox="0 0 ([0-9]+)[0-9.]* ([0-9]+)[0-9.]*".*/\1 \2/p' "$out/watch.svg")
chromium --headless --no-sandbox --disable-gpu --hide-scrollbars --force-device-scale-factor=1.5 \
  --window-size="$width,$height" --screenshot=docs/watch.png "file://$PWD/$out/watch.svg" \
  &> "$out/chromium.log"
