#!/usr/bin/env bash
# dask-kubernetes 2026.3.0 describes the pods of a DaskCluster by a copy of Kubernetes' pod that is older than 1.25: a worker may not have
# hostUsers (1.25), schedulingGates or resourceClaims (1.26), nor its container an appArmorProfile (1.30). A pod of one's own may have them;
# the same words under worker.spec are no part of the resource.
#
# Why it matters: a worker that itself makes namespaces, as a sandbox does, wants `procMount: Unmasked`, which is in the copy, and Kubernetes
# gives that only to pods with `hostUsers: false`, which is not. What is left is `privileged`.
# https://kubernetes.io/docs/concepts/workloads/pods/user-namespaces/
#
# Seen in November 2026, in the resource that the package's Helm chart installs: procMount known; hostUsers, schedulingGates, resourceClaims
# and appArmorProfile not, and no permission for unknown fields anywhere in it.
# Kubernetes' own list: https://kubernetes.io/docs/reference/kubernetes-api/workload-resources/pod-v1/
# Fails (exit 1) if that is different.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
python="$folder/venv/bin/python"
"$python" -m pip install --quiet --disable-pip-version-check PyYAML==6.0.3
"$python" -m pip install --quiet --disable-pip-version-check --no-deps dask-kubernetes==2026.3.0
cd "$folder"
"$python" - <<'PYTHON'
from importlib import metadata

import yaml

files = [one for one in metadata.files("dask-kubernetes") if str(one).endswith("crds/daskcluster.yaml")]
assert len(files) == 1, files
text = files[0].read_text()
schema = yaml.safe_load(text)["spec"]["versions"][0]["schema"]["openAPIV3Schema"]
pod = schema["properties"]["spec"]["properties"]["worker"]["properties"]["spec"]["properties"]
context = pod["containers"]["items"]["properties"]["securityContext"]["properties"]
of_pod = {name: name in pod for name in ("containers", "nodeSelector", "hostUsers", "schedulingGates", "resourceClaims")}
of_container = {name: name in context for name in ("privileged", "procMount", "appArmorProfile")}
print(f"dask-kubernetes {metadata.version('dask-kubernetes')}")
print("a worker's pod:", of_pod)
print("its container's securityContext:", of_container)
assert [name for name, known in of_pod.items() if known] == ["containers", "nodeSelector"]
assert [name for name, known in of_container.items() if known] == ["privileged", "procMount"]
assert "x-kubernetes-preserve-unknown-fields" not in text
print("As found.")
PYTHON
