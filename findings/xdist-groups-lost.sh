#!/usr/bin/env bash
# `pytest.mark.xdist_group` with `--dist loadgroup` promises that tests of one group run in one worker. With pytest-xdist 3.8.0 and
# pytest 9.2.0 the mark is lost without a word, and a group's tests are dealt out one by one: a module-scoped fixture that is dear to
# set up is set up once for each worker.
#
# Why: xdist writes the group into the item's private `_nodeid`, and this pytest reads its id from elsewhere.
#
# Seen in November 2026: eight tests of one group on two workers run in both; with pytest 8.4.2 and the same xdist, in one.
# Fails (exit 1) if that is different.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cat >"$folder/test_group.py" <<'PYTHON'
import pathlib
import time

import pytest


@pytest.mark.xdist_group("one")
@pytest.mark.parametrize("number", range(8))
def test_of_a_group(number, worker_id):
    time.sleep(0.2)
    with open(pathlib.Path(__file__).with_name("workers"), "a") as seen:
        seen.write(f"{worker_id}\n")
PYTHON

workers() { # how many workers the eight tests ran in, with this version of pytest
    python3 -m venv --clear "$folder/venv"
    "$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check "pytest==$1" pytest-xdist==3.8.0
    rm -f "$folder/workers"
    (cd "$folder" && venv/bin/python -m pytest -q -n 2 --dist loadgroup -p no:cacheprovider test_group.py >/dev/null)
    sort -u "$folder/workers" | wc -l
}

older=$(workers 8.4.2)
newer=$(workers 9.2.0)
echo "workers that ran one group: $older with pytest 8.4.2, $newer with pytest 9.2.0"
[ "$older" = 1 ] && [ "$newer" = 2 ]
