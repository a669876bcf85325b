#!/bin/bash
# Start of the extension: at the first one an example config and a token; then the service as a user
# of its own, without capabilities. What is printed here is in BlueOS's log of the extension.
set -euo pipefail

OWN=/usr/blueos/extensions/aquaflow  # what /data is on the vehicle
as_user=(setpriv --reuid aquaflow --regid aquaflow --init-groups --no-new-privs --bounding-set=-all)

install -d -o aquaflow -g aquaflow /data /data/cache
[[ -f /data/aquaflow.yaml ]] || install -o aquaflow -g aquaflow -m 0640 /opt/aquaflow/share/aquaflow.yaml /data/aquaflow.yaml
if [[ ! -s /data/token ]]; then
  (umask 0077; /opt/aquaflow/bin/python -c 'import secrets; print(secrets.token_urlsafe(16))' >/data/token)
fi
# An upload by the File Browser belongs to root.
chown aquaflow:aquaflow /data/token /data/aquaflow.yaml
chmod 0600 /data/token

echo "AquaFlow's page is in BlueOS's menu. It asks each browser once for this token: $(</data/token)"
echo "Token, settings and dives: $OWN/token, $OWN/aquaflow.yaml, $OWN/dives"
echo "What can be seen from here, with the lines for aquaflow.yaml:"
"${as_user[@]}" /opt/aquaflow/bin/aquaflow doctor devices || true
exec "${as_user[@]}" /opt/aquaflow/bin/aquaflow run --config /data/aquaflow.yaml
