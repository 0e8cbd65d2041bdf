#!/bin/sh
# need_browser.sh VENV: the browser of the tests ($CHROMIUM, else chromium-headless-shell, which needs a quarter less of the
# processor, else chromium) and what playwright's driver in VENV needs of Debian; installed where they are missing and that is
# allowed, else one line says what to do.
set -eu
venv=$1

fail() {
    echo "$1" >&2
    exit 1
}

missing() {
    if [ -n "${CHROMIUM:-}" ]; then
        command -v "$CHROMIUM" >/dev/null || fail "CHROMIUM=$CHROMIUM: no such program"
    else
        command -v chromium-headless-shell >/dev/null || command -v chromium >/dev/null || echo chromium-headless-shell
    fi
    "$venv"/lib/python3*/site-packages/playwright/driver/node --version >/dev/null 2>&1 || echo libatomic1
}

packages=$(missing)
[ -n "$packages" ] || exit 0
"$(dirname "$0")/apt_install.sh" $packages || true
packages=$(missing)
[ -z "$packages" ] || fail "The browser tests need more: apt-get install $(echo $packages) (or CHROMIUM=/path/to/chromium)"
