"""The package's structure in figures: one column for each checkout, so that before and after stand side by side.

    python tools/structure.py ../before .

A package is a folder in ``fgreg/``, or a module directly in ``fgreg/``. All imports count, also those in functions and
under TYPE_CHECKING. Layers are packages in the longest chain of imports; those in a circle share one. Public names are
those of ``fgreg.__all__``.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import grimp
import numpy as np
from scipy.sparse.csgraph import connected_components

ROOT = "fgreg"
Arrows = dict[str, set[str]]


@dataclass(frozen=True, slots=True)
class Structure:
    """Counts of a checkout.

    Attributes:
        files, lines: of each package.
        flat: modules directly in the package, ``__init__`` and ``__main__`` among them.
        arrows: each package, and the packages that it imports.
        package_circles, file_circles: packages, or files, that import each other in a loop.
        public: names of the public API.
    """

    files: dict[str, int]
    lines: dict[str, int]
    flat: tuple[str, ...]
    arrows: Arrows
    package_circles: tuple[tuple[str, ...], ...]
    file_circles: tuple[tuple[str, ...], ...]
    public: tuple[str, ...]

    @property
    def layers(self) -> int:
        """Packages in the longest chain of imports; 1 where none imports another."""
        circle = {name: circle for circle in self.package_circles for name in circle}

        @cache
        def depth(names: tuple[str, ...]) -> int:
            below = {circle.get(b, (b,)) for name in names for b in self.arrows[name]} - {names}
            return 1 + max((depth(other) for other in below), default=0)

        return max(depth(circle.get(name, (name,))) for name in self.arrows)


def circles(arrows: Arrows) -> tuple[tuple[str, ...], ...]:
    """Groups of two or more that import each other, directly or not."""
    names = sorted(arrows)
    reaches = np.array([[other in arrows[name] for other in names] for name in names])
    _, label = connected_components(reaches, connection="strong")
    groups = [tuple(name for name, own in zip(names, label, strict=True) if own == k) for k in range(max(label) + 1)]
    return tuple(sorted(group for group in groups if len(group) > 1))


def public_names(package: Path) -> tuple[str, ...]:
    """``__all__`` of the package, or of its module ``api``, as written there; none where there is no list."""
    for path in (package / "__init__.py", package / "api.py"):
        for statement in ast.parse(path.read_text(encoding="utf-8")).body if path.is_file() else ():
            targets = statement.targets if isinstance(statement, ast.Assign) else [getattr(statement, "target", None)]
            value = getattr(statement, "value", None)
            named = any(isinstance(target, ast.Name) and target.id == "__all__" for target in targets)
            if named and isinstance(value, ast.List | ast.Tuple):
                return tuple(str(part.value) for part in value.elts if isinstance(part, ast.Constant))
    return ()


def measure(checkout: Path) -> Structure:
    """Count a checkout; none of its code is run."""
    loaded = sys.modules.pop(ROOT, None)  # it would be counted in place of the checkout's
    sys.path.insert(0, str(checkout.resolve()))
    importlib.invalidate_caches()
    try:
        graph = grimp.build_graph(ROOT, cache_dir=None)
    finally:
        del sys.path[0]
        if loaded is not None:
            sys.modules[ROOT] = loaded
    files: Arrows = {}
    for module in graph.modules:
        files[module] = graph.find_modules_directly_imported_by(module)

    def package_of(module: str) -> str:
        return module.split(".")[1] if module != ROOT else "__init__"

    arrows: Arrows = {package_of(module): set() for module in files}
    count, lines = dict.fromkeys(arrows, 0), dict.fromkeys(arrows, 0)
    for module, imported in files.items():
        package = package_of(module)
        arrows[package] |= {package_of(other) for other in imported} - {package}
        path = checkout.joinpath(*module.split("."))
        path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
        count[package] += 1
        lines[package] += len(path.read_text(encoding="utf-8").splitlines())
    return Structure(
        files=count,
        lines=lines,
        flat=tuple(sorted(path.stem for path in (checkout / ROOT).glob("*.py"))),
        arrows=arrows,
        package_circles=circles(arrows),
        file_circles=circles(files),
        public=public_names(checkout / ROOT),
    )


def table(found: list[Structure]) -> list[list[str]]:
    """Rows of the summary, then lines and files of each package."""
    rows = [
        ["lines", *(f"{sum(one.lines.values()):,}" for one in found)],
        ["files", *(str(sum(one.files.values())) for one in found)],
        ["packages and flat modules", *(str(len(one.files)) for one in found)],
        ["flat modules", *(str(len(one.flat)) for one in found)],
        ["layers", *(str(one.layers) for one in found)],
        ["imports between packages", *(str(sum(map(len, one.arrows.values()))) for one in found)],
        ["circles of packages", *(str(len(one.package_circles)) for one in found)],
        ["circles of files", *(str(len(one.file_circles)) for one in found)],
        ["names in the public API", *(str(len(one.public)) for one in found)],
        ["", *("lines (files)" for _ in found)],
    ]
    names = sorted({name for one in found for name in one.files})
    return rows + [
        [f"  {name}", *(f"{one.lines[name]:,} ({one.files[name]})" if name in one.files else "-" for one in found)]
        for name in names
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkouts", type=Path, nargs="*", default=[Path()], help="folders that hold fgreg/")
    checkouts = parser.parse_args().checkouts
    found = [measure(checkout) for checkout in checkouts]
    rows = [["", *map(str, checkouts)], *table(found)]
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    for first, *others in rows:
        print(first.ljust(widths[0]), *(text.rjust(width) for text, width in zip(others, widths[1:], strict=True)))
    for checkout, one in zip(checkouts, found, strict=True):
        for circle in (*one.package_circles, *one.file_circles):
            print(f"circle in {checkout}: {', '.join(circle)}")


if __name__ == "__main__":
    main()
