"""The size of the house: lines, modules, classes, constants and parameters, by package.

    PYTHONPATH=.:cli:schemas:viewer python benchmarks/sizes.py

Prints a Markdown row for each package. No test holds these numbers: look at them before and after a
change, and ask what the growth is for. On 27 November 2026, before recordings as people make them
were read: 63 884 lines, 300 modules, 485 classes, 1 411 constants, 71 parameters. A day later:
70 397 lines, 331 modules, 525 classes, 1 478 constants, 71 parameters.
"""

from __future__ import annotations

import ast
from collections import Counter
from pathlib import Path

from hiros_mcap.config import Config, settable

ROOT = Path(__file__).parent.parent
PACKAGES = "hiros_mcap", "cli/hiros_cli", "viewer/hiros_viewer", "schemas/hiros_schemas"
COLUMNS = "lines", "modules", "classes", "functions", "constants"


def counts_of(folder: Path) -> Counter[str]:
    """Count what the modules below a folder hold."""
    counts = Counter[str]()
    for path in folder.rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        tree = ast.parse(text)
        counts["lines"] += text.count("\n")
        counts["modules"] += 1
        for node in ast.walk(tree):
            counts["classes"] += isinstance(node, ast.ClassDef)
            counts["functions"] += isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        counts["constants"] += sum(map(is_constant, tree.body))
    return counts


def is_constant(node: ast.stmt) -> bool:
    """Whether a statement gives names in capitals a value."""
    targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
    names = [name.id for t in targets if t for name in ast.walk(t) if isinstance(name, ast.Name)]
    return bool(names) and all(name.isupper() for name in names)


def main() -> None:
    print(f"| package | {' | '.join(COLUMNS)} |\n|---|{'---|' * len(COLUMNS)}")
    total = Counter[str]()
    for package in PACKAGES:
        counts = counts_of(ROOT / package)
        total += counts
        print(f"| {package} | {' | '.join(str(counts[name]) for name in COLUMNS)} |")
    print(f"| all | {' | '.join(str(total[name]) for name in COLUMNS)} |")
    parameters = sum(len(settable(field.default)) for field in Config.model_fields.values())
    print(f"\n{parameters} parameters for users")


if __name__ == "__main__":
    main()
