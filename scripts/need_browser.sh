#!/bin/sh
# The browser that the tests drive: $CHROMIUM, else chromium; installed where it is missing and that is allowed.
set -eu
if [ -n "${CHROMIUM:-}" ]; then
    command -v "$CHROMIUM" >/dev/null && exit 0
    echo "CHROMIUM=$CHROMIUM: no such program" >&2
    exit 1
fi
command -v chromium >/dev/null && exit 0
"$(dirname "$0")/apt_install.sh" chromium && exit 0
echo "The browser tests need chromium: apt-get install chromium, or set CHROMIUM=/path/to/it" >&2
exit 1
