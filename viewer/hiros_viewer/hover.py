"""Values of curves under the pointer: data beside each figure, and one short script per page."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_POINT = 72.0
"""Units of an SVG by matplotlib are points, of which an inch has so many."""
_DIGITS = 5

STYLE = """
figure { position: relative; }
.at { position: absolute; pointer-events: none; background: #1b1f24; color: #fff;
      padding: .2rem .5rem; border-radius: 3px; font: 12px/1.4 system-ui, sans-serif;
      white-space: pre; display: none; }
"""

SCRIPT = """
for (const figure of document.querySelectorAll("figure[data-curves]")) {
  const svg = figure.querySelector("svg"), all = JSON.parse(figure.dataset.curves);
  const box = figure.appendChild(document.createElement("div")); box.className = "at";
  const cursors = all.map(a => {
    const line = document.createElementNS("http://www.w3.org/2000/svg", "line");
    line.setAttribute("y1", a.top); line.setAttribute("y2", a.bottom);
    line.setAttribute("stroke", "#57606a"); line.style.display = "none";
    return svg.appendChild(line);
  });
  const hide = () => { for (const e of [box, ...cursors]) e.style.display = "none"; };
  figure.addEventListener("pointerleave", hide);
  figure.addEventListener("pointermove", event => {
    const p = new DOMPoint(event.clientX, event.clientY)
      .matrixTransform(svg.getScreenCTM().inverse());
    const on = all.find(a => p.x >= a.left && p.x <= a.right && p.y >= a.top && p.y <= a.bottom);
    hide();
    if (!on) return;
    const x = on.x[0] + (p.x - on.left) / (on.right - on.left) * (on.x[1] - on.x[0]);
    const values = on.curves.map(c => {
      let k = 0;
      c.x.forEach((v, i) => { if (v !== null && Math.abs(v - x) < Math.abs(c.x[k] - x)) k = i; });
      return c.y[k] === null || Math.abs(c.x[k] - x) > on.reach ? "" : c.name + "  " + c.y[k];
    }).filter(text => text);
    all.forEach((a, i) => {
      const there = a.left + (x - a.x[0]) / (a.x[1] - a.x[0]) * (a.right - a.left);
      cursors[i].setAttribute("x1", there); cursors[i].setAttribute("x2", there);
      if (there >= a.left && there <= a.right) cursors[i].style.display = "";
    });
    box.textContent = [x.toPrecision(4) + " " + on.unit, ...values].join("\\n");
    box.style.display = "block";
    const place = figure.getBoundingClientRect();
    const beside = event.clientX - place.left + 14;
    box.style.left = Math.min(beside, place.width - box.offsetWidth) + "px";
    box.style.top = event.clientY - place.top + 14 + "px";
  });
}
"""


def curves_json(figure: Figure) -> str:
    """Return the named curves of a drawn figure and where its plots are, "" if there are none."""
    plots = [plot for axes in figure.axes if (plot := _plot(axes, figure))]
    return json.dumps(plots, separators=(",", ":")) if plots else ""


def _plot(axes: Axes, figure: Figure) -> dict[str, Any]:
    """Return one plot of which some curve has a name."""
    lines = [line for line in axes.lines if not str(line.get_label()).startswith("_")]
    if not lines:
        return {}
    box, height = axes.get_position(), figure.get_figheight() * _POINT
    width = figure.get_figwidth() * _POINT
    low, high = axes.get_xlim()
    return {
        "left": round(box.x0 * width, 1),
        "right": round(box.x1 * width, 1),
        "top": round(height - box.y1 * height, 1),
        "bottom": round(height - box.y0 * height, 1),
        "x": [low, high],
        "reach": (high - low) / 50,
        "unit": axes.get_xlabel() or "s",
        "curves": [
            {
                "name": str(line.get_label()),
                "x": _numbers(line.get_xdata()),
                "y": _numbers(line.get_ydata()),
            }
            for line in lines
        ],
    }


def _numbers(values: Any) -> list[float | None]:
    """Return short numbers; None where there is none."""
    table = np.asarray(values, float)
    return [float(f"{v:.{_DIGITS}g}") if np.isfinite(v) else None for v in table]
