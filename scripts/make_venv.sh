#!/bin/sh
# make_venv.sh PYTHON DIRECTORY: make a virtual environment, or say in one line what is missing.
set -eu
python=$1 directory=$2
line="apt-get update && apt-get install -y make python3-venv"

fail() {
    echo "$1" >&2
    exit 1
}

command -v "$python" >/dev/null || fail "$python is missing: $line"
"$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' ||
    fail "Python 3.11 or later is needed, and $python is $("$python" --version 2>&1): make PYTHON=/path/to/python3.11"
"$python" -c 'import venv, ensurepip' 2>/dev/null || fail "python3-venv is missing: $line"

[ ! -L "$directory" ] || fail "$directory is a link to an environment, which would be emptied: remove the link"
if ! output=$("$python" -m venv --clear "$directory" 2>&1); then
    rm -rf "$directory"
    case $output in
        *ensurepip* | *"No module named venv"*) fail "python3-venv is missing: $line" ;;
        *) fail "$python -m venv failed: $(echo "$output" | tail -n 1)" ;;
    esac
fi
