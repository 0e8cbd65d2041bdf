#!/usr/bin/env bash
# prove_dockerfile.sh PYTHON: run what the Dockerfile says without a container. Every RUN, CMD and HEALTHCHECK is taken from
# it and run in an empty environment (env -i), with a home and a file tree of its own under one temporary directory, where the
# image's absolute paths are made to point. Needs no root: making the user is left out, and it runs as whoever calls it.
set -euo pipefail
host_python=$(command -v "$1")
cd "$(dirname "$0")/.."
checkout=$PWD
root=$(mktemp -d)
server=
finish() {
    if [ -n "$server" ]; then kill "$server" 2>/dev/null && wait "$server" || true; fi
    rm -rf "$root"
}
trap finish EXIT

mkdir -p "$root/bin" "$root/home/wfsobs" "$root/tmp"
printf '#!/bin/sh\nexec "%s" "$@"\n' "$host_python" >"$root/bin/python"  # the base image's python
chmod +x "$root/bin/python"
port=$("$host_python" -c 'import socket; s = socket.socket(); s.bind(("localhost", 0)); print(s.getsockname()[1])')

# How pip reaches its index is the machine's affair, and comes along.
passed=()
while IFS= read -r name; do passed+=("$name=${!name}"); done < <(compgen -e | grep -iE '^(pip_.*|(https?|no|all)_proxy|ssl_cert_file|requests_ca_bundle)$' || true)

declare -A image
directory=$root
place() { sed -E "s#(^|[ =:\"'])/(src|dist|opt/wfsobs|home/wfsobs)#\1$root/\2#g; s#localhost:5006#localhost:$port#g; s#>/dev/null#>$root/tmp/out#g"; }
empty_env() {
    local settings=(PATH="$root/bin:/usr/bin:/bin" HOME="$root/home/wfsobs" TMPDIR="$root/tmp" LANG=C.UTF-8)
    for name in "${!image[@]}"; do settings+=("$name=${image[$name]}"); done
    cd "$directory"
    exec env -i "${passed[@]}" "${settings[@]}" "$@"
}
run() { echo "RUN $1"; (empty_env bash -euc "$1"); }
words() { "$host_python" -c 'import json, sys; print("\n".join(json.load(sys.stdin)))'; }

stage=0 command=() health=
while IFS= read -r line; do
    word=${line%% *} rest=${line#* }
    case $word in
        FROM) stage=$((stage + 1)); image=(); directory=$root; echo "FROM $rest" ;;
        COPY)
            case $rest in
                ". /src") mkdir -p "$root/src"; git ls-files -z --cached --others --exclude-standard | tar --null --files-from=- -c --ignore-failed-read 2>/dev/null | tar -x -C "$root/src" ;;
                "--from=build /opt/wfsobs /opt/wfsobs") test -x "$root/opt/wfsobs/bin/wfsobs" ;;
                *) echo "COPY $rest: not known here" >&2; exit 1 ;;
            esac ;;
        WORKDIR) directory=$(place <<<"$rest"); mkdir -p "$directory" ;;
        ENV)
            for pair in $rest; do
                value=$(place <<<"${pair#*=}")
                image[${pair%%=*}]=${value//\$PATH/$root/bin:/usr/bin:/bin}
            done ;;
        RUN)
            case $rest in
                useradd*) echo "RUN $rest: left out, needs root" ;;
                *) run "$(place <<<"$rest")" ;;
            esac ;;
        CMD) mapfile -t command < <(words <<<"$rest") ;;
        HEALTHCHECK) health=$(place <<<"${rest#*CMD }") ;;
        USER | EXPOSE) ;;
        *) echo "$word: not known here" >&2; exit 1 ;;
    esac
done < <(sed -E '/^\s*#/d; /^\s*$/d' Dockerfile | sed -E ':a; /\\$/N; s/\s*\\\n\s*/ /; ta')
[ "$stage" = 2 ] && [ ${#command[@]} -gt 0 ] && [ -n "$health" ]

echo "CMD ${command[*]} --port $port"
(empty_env "${command[@]}" --port "$port") >"$root/tmp/log" 2>&1 &
server=$!
for _ in $(seq 240); do
    if (empty_env bash -euc "$health") 2>/dev/null; then healthy=yes; break; fi
    sleep 0.5
done
[ "${healthy:-}" = yes ] || { cat "$root/tmp/log" >&2; echo "HEALTHCHECK $health: no answer" >&2; exit 1; }
echo "HEALTHCHECK $health: healthy"
kill -TERM "$server"
wait "$server" || { status=$?; cat "$root/tmp/log" >&2; echo "CMD ended with status $status" >&2; exit 1; }
server=
if grep -q Traceback "$root/tmp/log"; then cat "$root/tmp/log" >&2; exit 1; fi
cat "$root/tmp/log"
test "$PWD" = "$checkout"
echo "Dockerfile: every step ran"
