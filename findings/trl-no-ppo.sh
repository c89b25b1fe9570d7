#!/usr/bin/env bash
# TRL, with which much of the work on PPO for language models was done, has no PPO any more: no file of version 1.16.0 bears the name, not
# among its trainers, and not among what it calls experimental. Version 0.24.0 has a PPOTrainer. A tutorial's `from trl import PPOTrainer`
# fails.
#
# Seen in November 2026: 0.24.0 has trl/trainer/ppo_config.py and trl/trainer/ppo_trainer.py, 1.16.0 nothing.
# Fails (exit 1) if that is different.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
found() { # files of this version of TRL that have PPO in their names
    "$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check --no-deps "trl==$1"
    (cd "$folder"/venv/lib/python3*/site-packages && find trl -iname '*ppo*' -name '*.py' | sort | tr '\n' ' ')
}

older=$(found 0.24.0)
newer=$(found 1.16.0)
echo "0.24.0: ${older:-nothing}; 1.16.0: ${newer:-nothing}"
[[ "$older" == *trl/trainer/ppo_trainer.py* ]] && [ -z "$newer" ]
