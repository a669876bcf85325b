#!/bin/bash
# First start of the extension: an example config and a token; then the service as its own user.
set -euo pipefail

install -d -o aquaflow -g aquaflow /data /data/cache
[[ -f /data/aquaflow.yaml ]] || install -o aquaflow -g aquaflow -m 0640 /opt/aquaflow/share/aquaflow.yaml /data/aquaflow.yaml
if [[ ! -f /data/token ]]; then
  (umask 0077; /opt/aquaflow/bin/python -c 'import secrets; print(secrets.token_urlsafe(32))' >/data/token)
  chown aquaflow:aquaflow /data/token
fi
exec setpriv --reuid aquaflow --regid aquaflow --init-groups --no-new-privs --bounding-set=-all \
  /opt/aquaflow/bin/aquaflow run --config /data/aquaflow.yaml
