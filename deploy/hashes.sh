#!/usr/bin/env bash
# Fetch the wheels of an onboard install and write down their hashes, on a machine with a network and
# of the same kind as the vehicle's computer.
#
#   deploy/hashes.sh WHEELHOUSE [EXTRAS]      TORCH=cpu|cuda|system chooses the build of torch
#
# Then copy checkout and WHEELHOUSE, and run: sudo deploy/install.sh --wheelhouse WHEELHOUSE
set -euo pipefail

here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
checkout=$(dirname "$here")
wheelhouse=${1:?give a folder for the wheels}
extras=${2-prior,telemetry,recording}
python=${PYTHON:-python3}
# shellcheck source=deploy/torch.sh
source "$here/torch.sh"

build=$(choose_torch "$python" "${TORCH:-auto}")
pins=$(mktemp)
trap 'rm -f "$pins"' EXIT
cp "$checkout/constraints.txt" "$pins"
pin_torch "$build" "$python" "$pins"
index=()
[[ $build != cpu ]] || index=(--extra-index-url "$torch_cpu_index")
mkdir -p "$wheelhouse"
"$python" -m pip wheel --quiet --no-cache-dir "${index[@]}" --constraint "$pins" \
  --wheel-dir "$wheelhouse" "${checkout}${extras:+[$extras]}"
lock=$here/requirements.lock
: >"$lock"
for wheel in "$wheelhouse"/*.whl; do
  name=$(basename "$wheel")
  [[ $name == aquaflow-* ]] && continue
  package=${name%%-*} version=${name#*-}
  hash=$("$python" -c 'import hashlib, sys; print(hashlib.sha256(open(sys.argv[1], "rb").read()).hexdigest())' "$wheel")
  echo "${package}==${version%%-*} --hash=sha256:$hash" >>"$lock"
done
echo "hashes.sh: wrote $(wc -l <"$lock") hashes to $lock"
