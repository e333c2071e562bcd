"""Legend of a layout: the meaning of the colours that it shows, and of no others."""

from __future__ import annotations

from collections.abc import Iterator

import rerun as rr

from hiros_mcap.io.export.markers import PEOPLE
from hiros_viewer.blueprint import Content, blueprint, fitting
from hiros_viewer.entities import KEY, LONGEST_M, MAGNIFIED

HUES = ("orange", "blue", "pink", "teal", "aqua", "violet", "yellow", "red", "green", "mauve")
"""Names of the colours of people, and of logs that are overlaid."""


def lay_out(
    recording: rr.RecordingStream,
    content: Content,
    layout: str = "overview",
    *,
    follows: bool = False,
) -> None:
    """Send a layout with the lines that explain it; ``follows`` as in :func:`blueprint`."""
    explain(recording, content, layout)
    recording.send_blueprint(blueprint(content, layout, follows=follows))


def explain(
    recording: rr.RecordingStream, content: Content, layout: str = "overview", note: str = ""
) -> None:
    """Show what the colours of a layout mean, and a note."""
    text = f"{legend(content, layout)} {note}"
    recording.log(KEY, rr.TextDocument(text, media_type="text/markdown"), static=True)


def legend(content: Content, layout: str) -> str:
    """Return what the colours of a layout mean, Markdown."""
    layout = fitting(content, layout)
    if content.is_raw:
        sides = "**Bright**: right limbs. **Dark**: left limbs."
        cameras = " Each camera has its colour." * (len(content.cameras) > 1)
        truth = " **White**: the truth." * content.shows_truth
        return f"{sides}{cameras}{truth} Point at a curve for its name."
    logs = [
        f"**{layer.name}** is {HUES[layer.number % len(PEOPLE)]}{layer.file and f': {layer.file}'}."
        for layer in content.layers
        if layer.name
    ]
    sentences = [f"**{word}**: {meaning}." for word, meaning in _meanings(content, layout)]
    colours = " ".join([*sentences, "Point at a curve for its name."])
    return "  \n".join([*logs, colours])


def _meanings(content: Content, layout: str) -> Iterator[tuple[str, str]]:
    """Yield what is in the room and beside it, and what that is."""
    has_sided_curves = layout == "overview"
    if has_sided_curves and any(layer.name for layer in content.layers):
        yield "Bright", "right limbs and their curves"
        yield "Dark", "left ones"
    else:
        yield "Right", "bright limbs, blue curves" if has_sided_curves else "bright limbs"
        yield "Left", "dark limbs, grey curves" if has_sided_curves else "dark limbs"
    if layout == "stages":
        yield "Grey", content.before
        yield "Colour", content.final
        way = f"{MAGNIFIED:.0f} times the way from {content.final} to {content.before}"
        yield "Yellow", f"{way}, at most {LONGEST_M:.1f} m long"
    elif layout == "cameras" or not (content.shows_truth or content.hides_detections):
        yield "Thin lines", "what cameras report"
    if content.has_predicted:
        yield "Faint", "nobody sees the person, who is predicted"
    if content.shows_truth and layout == "overview":
        yield "Red", "the way to the truth"
        yield "White", "the truth"
    if content.shows_uncertainty:
        yield "Ellipsoids", "the true joint is inside with 68 %"
