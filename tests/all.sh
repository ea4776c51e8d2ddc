#!/bin/sh
# Run every test in the parts that README.md describes; exit with 1 if any of them failed.
# Arguments: pytest's options for tests that are distributed by file.
cd "$(dirname "$0")/.." || exit 1
mkdir -p out
rm -f out/skipped
failed=0
by_file=$*

some() {
  .venv/bin/python -m tests.quiet || exit 1
  echo ".venv/bin/pytest $*"
  .venv/bin/pytest --skipped out/skipped "$@" || failed=1
}

# Unit and sim tests run on what the others leave of the processor. An idle process shares it with
# its own session's processes only after them, so its session as a whole has to give way too.
setsid sh -c 'echo 19 > /proc/self/autogroup; exec chrt --idle 0 "$@"' sh \
  .venv/bin/pytest --skipped out/skipped --numprocesses auto $by_file tests/sim tests/unit \
  > out/quick.txt 2>&1 &
quick=$!
trap 'kill $quick 2> /dev/null' EXIT
trap 'exit 130' INT TERM

some --numprocesses 4 $by_file -m 'not real_time and not alone' tests/host tests/process
some --numprocesses auto $by_file -m real_time tests/process tests/host
wait $quick || failed=1
cat out/quick.txt
some -m alone tests/process tests/host
exit $failed
