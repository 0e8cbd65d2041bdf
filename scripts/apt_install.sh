#!/bin/sh
# apt_install.sh PACKAGE...: install Debian packages, as root or through sudo without a password; else fail, silently.
set -eu
command -v apt-get >/dev/null || exit 1
if [ "$(id -u)" = 0 ]; then
    sudo=
elif sudo -n true 2>/dev/null; then
    sudo="sudo -n"
else
    exit 1
fi
echo "Installing $* with apt-get ..."
$sudo apt-get update -qq </dev/null >/dev/null
$sudo env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@" </dev/null >/dev/null
