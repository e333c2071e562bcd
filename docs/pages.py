"""The pages that are generated when the site is built: commands, parameters, messages, Python.

A hook of MkDocs; ``mkdocs.yml`` names it. What these pages say comes from the code, so it cannot
become wrong.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files

ROOT = Path(__file__).parent.parent
WIDTH = 78
_ROLE = re.compile(r":(?:attr|class|data|func|meth|mod):(?:(<code>)~?|`~?([^`<]*)`)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages to those of the folder."""
    from mkdocs.structure.files import File

    for path, text in {**generated(), "walkthrough.md": walkthrough()}.items():
        files.append(File.generated(config, path, content=text))
    return files


def on_page_content(html: str, **_: Any) -> str:
    """Show names that docstrings cite (``:class:`Frame```) as code alone."""
    return _ROLE.sub(r"\1\2", html)


def generated() -> dict[str, str]:
    """Path of each generated page -> its Markdown."""
    pages: Mapping[str, Callable[[], str]] = {
        "changes.md": changes,
        "reference/commands.md": commands,
        "reference/messages.md": messages,
        "reference/parameters.md": parameters,
        "reference/python.md": python,
    }
    return {path: page() for path, page in pages.items()}


def walkthrough() -> str:
    """Run the notebook; return its cells and what they gave."""
    import nbclient
    import nbformat

    notebook: Any = nbformat.read(ROOT / "docs" / "walkthrough.ipynb", as_version=4)
    nbclient.NotebookClient(notebook, resources={"metadata": {"path": ROOT}}).execute()
    parts = []
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            parts.append(cell.source)
        else:
            parts.append(f"```python\n{cell.source}\n```")
            parts += map(_shown, cell.outputs)
    parts.append("[The notebook](walkthrough.ipynb)")
    return "\n\n".join(parts) + "\n"


def _shown(output: Any) -> str:
    """Markdown of what a cell gave: a picture, a table, else text."""
    data = output.get("data", {})
    if "image/png" in data:
        return f"![Result of the cell above](data:image/png;base64,{data['image/png'].strip()})"
    if "text/html" in data:
        return str(data["text/html"])
    return f"```text\n{output.get('text', data.get('text/plain', '')).rstrip()}\n```"


def changes() -> str:
    """Return the changelog; its links count from the root of the repository."""
    return (ROOT / "CHANGELOG.md").read_text(encoding="utf-8").replace("](docs/", "](")


def commands() -> str:
    """Return what ``--help`` of every command says."""
    from hiros_cli.commands import program

    root = program()
    above = root.make_context("hiros", [], resilient_parsing=True)
    parts = [
        "# Commands",
        "Exit codes: 0 done, 1 `hiros check` found a difference, 2 bad input or usage (one line on "
        "stderr, no output), 3 recovered with losses, 70 a bug of hiros, 128 + n stopped by "
        "signal n. Warnings go to stderr, also with `--quiet`.",
    ]
    for name, command in _leaves(root, "hiros"):
        own = name.removeprefix("hiros ")
        context = command.make_context(own, [], above, resilient_parsing=True)
        formatter = context.make_formatter()
        formatter.width = WIDTH
        command.format_help(context, formatter)
        parts.append(f"## {name}\n\n```text\n{formatter.getvalue().strip()}\n```")
    return "\n\n".join(parts) + "\n"


def _leaves(command: Any, name: str) -> Iterator[tuple[str, Any]]:
    """Yield every command that does something, with its full name."""
    below = getattr(command, "commands", None)
    if not below:
        yield name, command
        return
    for child, sub in below.items():
        yield from _leaves(sub, f"{name} {child}")


def parameters() -> str:
    """Return every parameter of every section: meaning, default, range; advanced ones last."""
    from hiros_mcap.config import Config

    parts = [
        "# Parameters",
        "`hiros config --system NAME` prints the parameters of one system with the values in "
        "effect. Set one with `--set section.parameter=value`, several with `--config FILE`. "
        "Most people never need the advanced ones.",
    ]
    for section, field in Config.model_fields.items():
        parts.append(f"## {section}\n\n{field.description}")
        parts += _tables(field.default)
    return "\n\n".join(parts) + "\n"


def _tables(params: Any) -> Iterator[str]:
    from hiros_mcap.config import settable
    from hiros_mcap.params import is_advanced

    fields = {name: type(params).model_fields[name] for name in settable(params)}
    schema = params.model_json_schema()["properties"]
    for title, wanted in (("", False), ("Advanced", True)):
        rows = [
            _row(params, name, schema[name])
            for name, field in fields.items()
            if is_advanced(field) == wanted
        ]
        if rows:
            heading = f"**{title}**\n\n" if title else ""
            header = "| parameter | default | what it is, and what is allowed |\n|---|---|---|\n"
            yield heading + header + "\n".join(rows)


def _row(params: Any, name: str, schema: Mapping[str, Any]) -> str:
    from hiros_mcap.config import allowed, toml_value

    description = " ".join((type(params).model_fields[name].description or "").split())
    default = toml_value(getattr(params, name))
    limits = f" Allowed: {values}." if (values := allowed(schema)) else ""
    cells = (f"`{name}`", f"`{default}`", _text(description + limits))
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


def _text(description: str) -> str:
    """Markdown that shows the description as it is."""
    return re.sub(r"([<>*_])", r"\\\1", description)


def messages() -> str:
    """Return the message definitions, comments included."""
    from hiros_schemas import NAMES, ROS_PACKAGE, type_hash

    parts = [
        "# Messages",
        "The folder `schemas/hiros_schemas/hiros_skeleton_msgs` is a complete ROS 2 interface "
        "package. Put it into a workspace and run `colcon build`. hiros reads and writes "
        "`SkeletonGroup`.",
    ]
    for name in NAMES:
        kind = name.rpartition("/")[2]
        text = (ROS_PACKAGE / "msg" / f"{kind}.msg").read_text(encoding="utf-8").strip()
        title = f"## {kind}\n\n`{name}`, type hash `{type_hash(name)}`"
        parts.append(f"{title}\n\n```text\n{text}\n```")
    return "\n\n".join(parts) + "\n"


def python() -> str:
    """Return the public names with their docstrings."""
    import hiros_mcap
    import hiros_schemas

    parts = ["# Every Python name"]
    for module in (hiros_mcap, hiros_schemas):
        parts.append(f"## {module.__name__}\n\n{inspect.getdoc(module)}")
        parts += [f"::: {home}" for home in _public(module)]
    return "\n\n".join(parts) + "\n"


def _public(module: ModuleType) -> Iterator[str]:
    """Yield the full name of each public class and function of a module."""
    for name in module.__all__:
        value = getattr(module, name)
        if inspect.isclass(value) or inspect.isfunction(value):
            yield f"{module.__name__}.{name}"
