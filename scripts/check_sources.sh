#!/usr/bin/env bash
# check_sources.sh PYTHON: build the wheel from a source zip, from a checkout without links and from the sdist; each has
# to hold every file of the package and both licences. PYTHON needs build and setuptools. What is checked is the last commit.
set -euo pipefail
python=$(command -v "$1")
case $python in /*) ;; *) python=$PWD/$python ;; esac
checkout=$(cd "$(dirname "$0")/.." && pwd -P)
if [ ! -e "$checkout/.git" ]; then echo "Not a git checkout: zip, clone and sdist are not compared"; exit 0; fi
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT

wheel() {  # NAME SOURCE [OPTION]: dist/NAME has what is built from the folder SOURCE
    "$python" -m build --no-isolation ${3:+"$3"} --outdir "$place/dist/$1" "$2" >"$place/log" 2>&1 || { cat "$place/log" >&2; exit 1; }
}

git -C "$checkout" archive --format=zip --prefix=zip/ --output="$place/source.zip" HEAD
(cd "$place" && "$python" -m zipfile -e source.zip .)  # which knows no links, as Windows does not
git -c core.symlinks=false clone --quiet --no-local "$checkout" "$place/clone"
for links in zip clone; do
    if [ -L "$place/$links/app" ] || [ -L "$place/$links/assets" ]; then echo "$links: has links" >&2; exit 1; fi
done

wheel zip "$place/zip" --wheel
wheel clone "$place/clone" --wheel
wheel sdist "$place/clone"  # the sdist, and the wheel from it

"$python" - "$checkout" "$place/dist" <<'PY'
import pathlib, subprocess, sys, zipfile

checkout, built = map(pathlib.Path, sys.argv[1:])
tree = subprocess.run(["git", "ls-tree", "-r", "--name-only", "HEAD", "wfsobs"], cwd=checkout, check=True, capture_output=True, text=True)
needed = set(tree.stdout.split())
for source in ("zip", "clone", "sdist"):
    (wheel,) = (built / source).glob("*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    lost = needed - names
    assert not lost, f"{source}: not in the wheel: {sorted(lost)}"
    more = {n for n in names if ".dist-info/" not in n} - needed
    assert not more, f"{source}: in the wheel, and not in the sources: {sorted(more)}"
    licences = {n.split("/")[-1] for n in names if ".dist-info/licenses/" in n}
    assert licences == {"LICENSE", "eris_ut4.LICENSE.txt"}, f"{source}: licences in the wheel: {sorted(licences)}"
    print(f"Wheel from {source}: {len(needed)} files of the package, {len(licences)} licences")
PY
