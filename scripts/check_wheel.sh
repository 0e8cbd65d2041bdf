#!/usr/bin/env bash
# check_wheel.sh PYTHON WHEEL: install the wheel in an empty environment outside the checkout, first without and then
# with the dashboard; run the command, import every module, serve, fetch the page and the health check.
set -euo pipefail
python=$1
wheel=$(realpath "$2")
checkout=$(cd "$(dirname "$0")/.." && pwd -P)
export OPENBLAS_NUM_THREADS=1
unset PYTHONPATH VIRTUAL_ENV

place=$(mktemp -d)
server=
finish() {
    if [ -n "$server" ]; then kill "$server" 2>/dev/null && wait "$server" || true; fi
    rm -rf "$place"
}
trap finish EXIT
cd "$place"

"$checkout/scripts/make_venv.sh" "$python" "$place/venv"
install=("$place/venv/bin/python" -m pip --disable-pip-version-check install --quiet -c "$checkout/requirements.txt")

echo "Wheel alone: run the command"
"${install[@]}" "$wheel"
venv/bin/wfsobs --version
venv/bin/wfsobs run --set run.duration=2 --json >rows.json
venv/bin/python - <<'PY'
import importlib.util, json
rows = json.load(open("rows.json"))
assert rows, "no rows"
assert importlib.util.find_spec("panel") is None, "panel came with the core"
print(len(rows), "rows")
PY

echo "Wheel with [app]: dashboard"
"${install[@]}" "$wheel[app]"
port=$(venv/bin/python -c 'import socket; s = socket.socket(); s.bind(("localhost", 0)); print(s.getsockname()[1])')
venv/bin/wfsobs serve --port "$port" >serve.log 2>&1 &
server=$!
if ! venv/bin/python - "$port" <<'PY'
import sys, time, urllib.error, urllib.request
base = f"http://localhost:{sys.argv[1]}"

def fetch(path):
    with urllib.request.urlopen(base + path, timeout=30) as answer:
        return answer.read().decode()

for attempt in range(480):
    try:
        fetch("/liveness")
        break
    except urllib.error.HTTPError:
        raise
    except OSError:
        time.sleep(0.5)
else:
    sys.exit("no answer in four minutes")
page = fetch("/")
assert "bokeh" in page and "<html" in page, page[:500]
print("served", len(page), "characters, and /liveness")
PY
then
    cat serve.log >&2
    exit 1
fi
if grep -q Traceback serve.log; then
    cat serve.log >&2
    exit 1
fi

echo "Wheel with [app,plot]: modules, assets"
"${install[@]}" "$wheel[app,plot]"
venv/bin/python - "$checkout" <<'PY'
import importlib, pathlib, pkgutil, sys
import wfsobs, wfsobs.app, wfsobs.assets
checkout = pathlib.Path(sys.argv[1])
names = [m.name for m in pkgutil.walk_packages(wfsobs.__path__, "wfsobs.") if not m.name.endswith(("__main__", "app.main"))]
for name in names:
    importlib.import_module(name)
inside = [name for name, m in sys.modules.items() if checkout in pathlib.Path(getattr(m, "__file__", None) or "/").parents]
assert not inside, f"imported from the checkout: {inside}"

def files(folder):
    return {str(f.relative_to(folder)) for f in folder.rglob("*") if f.is_file() and "__pycache__" not in f.parts}

installed = pathlib.Path(wfsobs.__file__).parent
lost = files(checkout / "wfsobs") - files(installed)
assert not lost, f"not in the wheel: {lost}"
print(len(names), "modules,", len(files(installed / "assets")), "assets")
PY

echo "Wheel: all is well"
