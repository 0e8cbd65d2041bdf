"""Count the circles between modules: sets of which each imports, perhaps by way of others, every other one.

Imports for types alone and those inside functions count. `python scripts/count_circles.py` prints the circles; the status is 1
with any.
"""

from __future__ import annotations

import sys

import grimp
import numpy as np
from scipy.sparse.csgraph import connected_components


def circles(package: str) -> list[list[str]]:
    """Return the sets of modules of a package that import each other."""
    graph = grimp.build_graph(package, exclude_type_checking_imports=False, cache_dir=None)
    modules = sorted(graph.modules)
    imports = np.zeros((len(modules), len(modules)), dtype=bool)
    for i, module in enumerate(modules):
        imports[i, [modules.index(other) for other in graph.find_modules_directly_imported_by(module)]] = True
    count, labels = connected_components(imports, connection="strong")
    sets = [[m for m, label in zip(modules, labels, strict=True) if label == k] for k in range(count)]
    return sorted(s for s in sets if len(s) > 1)


if __name__ == "__main__":
    found = circles("wfsobs")
    print(f"{len(found)} circles")
    for one in found:
        print(" ", ", ".join(one))
    sys.exit(bool(found))
