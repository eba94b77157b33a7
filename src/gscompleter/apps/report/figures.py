"""SVG figures of a report: curves, scatter plots, bars, colour scales."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from xml.etree.ElementTree import Element, SubElement, tostring

import numpy as np
from markupsafe import Markup

from gscompleter.apps.report.depth_picture import NO_DEPTH_COLOR, make_palette

WIDTH, HEIGHT = 360.0, 220.0
LEFT, BOTTOM, TOP, RIGHT = 52.0, 40.0, 12.0, 12.0
"""Margins around the axes."""
BAR_HEIGHT, BAR_GAP = 16.0, 10.0
NAME_WIDTH, MAX_BAR_WIDTH = 96.0, 230.0
NUM_PATCHES = 48


@dataclass(frozen=True)
class Axis:
    """A linear axis: its range in values and in drawing units."""

    low: float
    high: float
    start: float
    end: float

    def __call__(self, value: float) -> float:
        """Compute the drawing position of a value."""
        return self.start + (value - self.low) / (self.high - self.low) * (self.end - self.start)


def create_figure(title: str, description: str, width: float, height: float, kind: str) -> Element:
    """Create an empty drawing with a title and a description for screen readers."""
    svg = Element(
        "svg", {"viewBox": f"0 0 {width:g} {height:g}", "role": "img", "class": f"figure {kind}"}
    )
    SubElement(svg, "title").text = title
    SubElement(svg, "desc").text = description
    return svg


def serialize_figure(svg: Element) -> Markup:
    """Serialize a drawing for a page."""
    return Markup(tostring(svg, encoding="unicode"))


def add_element(
    parent: Element, tag: str, text: str | None = None, **attributes: object
) -> Element:
    """Add an element; numbers get two decimals, and `class_` becomes class."""
    written = {
        name.rstrip("_").replace("_", "-"): format_attribute(value)
        for name, value in attributes.items()
    }
    element = SubElement(parent, tag, written)
    element.text = text
    return element


def format_attribute(value: object) -> str:
    """Format the value of an attribute."""
    return f"{round(value, 2):g}" if isinstance(value, float) else str(value)


def compute_ticks(low: float, high: float, most: int = 5) -> list[float]:
    """Return round numbers from `low` to `high`."""
    raw = (high - low) / most
    size = 10.0 ** math.floor(math.log10(raw))
    step = next(size * factor for factor in (1, 2, 5, 10) if size * factor >= raw * (1 - 1e-9))
    return [
        k * step for k in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)
    ]


def compute_span(values: Sequence[float]) -> tuple[float, float]:
    """Compute an axis range around `values`, never empty."""
    low, high = min(values), max(values)
    padding = 0.05 * ((high - low) or abs(high) or 1.0)
    return low - padding, high + padding


def draw_axes(
    svg: Element, x: tuple[float, float], y: tuple[float, float], names: Sequence[str]
) -> list[Axis]:
    """Draw two axes with a grid and return them."""
    low, middle = HEIGHT - BOTTOM, (HEIGHT - BOTTOM + TOP) / 2
    across, up = Axis(*x, LEFT, WIDTH - RIGHT), Axis(*y, low, TOP)
    for value in compute_ticks(*x):
        at = across(value)
        add_element(svg, "line", class_="grid", x1=at, x2=at, y1=TOP, y2=low)
        add_label(svg, f"{value:g}", "tick", at, low + 14, "middle")
    for value in compute_ticks(*y):
        at = up(value)
        add_element(svg, "line", class_="grid", x1=LEFT, x2=WIDTH - RIGHT, y1=at, y2=at)
        add_label(svg, f"{value:g}", "tick", LEFT - 6, at + 4, "end")
    add_label(svg, names[0], "name", (LEFT + WIDTH - RIGHT) / 2, HEIGHT - 6, "middle")
    turned = add_label(svg, names[1], "name", 12.0, middle, "middle")
    turned.set("transform", f"rotate(-90 12 {middle:g})")
    return [across, up]


def add_label(
    svg: Element, text: str, kind: str, x: float, y: float, anchor: str = "start"
) -> Element:
    """Add a text at a position."""
    return add_element(svg, "text", text, class_=kind, x=x, y=y, text_anchor=anchor)


def plot_loss(title: str, losses: Sequence[float]) -> Markup | None:
    """Plot the loss over the iterations, or return None for less than two."""
    known = [(float(k), loss) for k, loss in enumerate(losses, start=1) if math.isfinite(loss)]
    if len(known) < 2:
        return None
    first, last = known[0][1], known[-1][1]
    text = f"A curve over {len(losses)} iterations, from {first:.3g} to {last:.3g}."
    svg = create_figure(title, text, WIDTH, HEIGHT, "plot")
    x, y = draw_axes(
        svg,
        (0.0, float(len(losses))),
        compute_span([loss for _, loss in known]),
        ("iteration", "loss"),
    )
    points = " ".join(f"{x(k):.1f},{y(loss):.1f}" for k, loss in known)
    add_element(svg, "polyline", class_="curve", points=points)
    return serialize_figure(svg)


def plot_depth_scatter(
    pairs: Sequence[tuple[float, float, bool]], scale: float, shift: float, unit: str
) -> Markup | None:
    """Plot lifted against scene depths with the fitted line, or return None without pairs.

    Args:
        pairs: Lifted depth, scene depth, and True for an inlier.
        scale: Scale of the fit.
        shift: Shift of the fit.
        unit: Unit of the depths.
    """
    known = [pair for pair in pairs if math.isfinite(pair[0] + pair[1])]
    if not known or not math.isfinite(scale + shift):
        return None
    share = sum(agrees for *_, agrees in known) / len(known)
    line = f"{scale:.3f} times depth plus {shift:.3g}"
    text = f"{len(known)} pixels; {share:.0%} lie on the line {line}."
    svg = create_figure("Lifted depth against scene depth", text, WIDTH, HEIGHT, "plot")
    ranges = compute_span([p for p, _, _ in known]), compute_span([c for _, c, _ in known])
    x, y = draw_axes(svg, *ranges, (f"lifted depth ({unit})", f"scene depth ({unit})"))
    for agrees, kind in ((False, "outlier"), (True, "inlier")):
        dots = [f"M{x(p):.1f} {y(c):.1f}h0" for p, c, fits in known if fits == agrees]
        add_element(svg, "path", class_=kind, d="".join(dots))
    ends = clip_line(scale, shift, *ranges)
    if ends is not None:
        (x1, y1), (x2, y2) = ends
        add_element(svg, "line", class_="fit", x1=x(x1), y1=y(y1), x2=x(x2), y2=y(y2))
    return serialize_figure(svg)


def clip_line(
    scale: float, shift: float, x: tuple[float, float], y: tuple[float, float]
) -> tuple[tuple[float, float], tuple[float, float]] | None:
    """Clip a rising line to a rectangle, or return None if they do not meet."""
    if scale <= 0:
        return None
    low, high = max(x[0], (y[0] - shift) / scale), min(x[1], (y[1] - shift) / scale)
    return ((low, scale * low + shift), (high, scale * high + shift)) if low < high else None


def draw_time_bars(title: str, seconds: Mapping[str, float]) -> Markup | None:
    """Draw one bar per stage, or return None if no stage took time."""
    known = {name: s for name, s in seconds.items() if math.isfinite(s) and s >= 0}
    longest = max(known.values(), default=0.0)
    if longest <= 0:
        return None
    text = ", ".join(f"{name} {s:.2f} s" for name, s in known.items())
    height = len(known) * (BAR_HEIGHT + BAR_GAP)
    svg = create_figure(title, f"{text}.", NAME_WIDTH + MAX_BAR_WIDTH + 60, height, "bars")
    for row, (name, s) in enumerate(known.items()):
        top, width = row * (BAR_HEIGHT + BAR_GAP), s / longest * MAX_BAR_WIDTH
        add_label(svg, name, "name", NAME_WIDTH - 8, top + 13, "end")
        add_element(
            svg, "rect", class_="bar", x=NAME_WIDTH, y=top, width=width, height=BAR_HEIGHT, rx=2.0
        )
        add_label(svg, f"{s:.2f} s", "tick", NAME_WIDTH + width + 8, top + 13)
    return serialize_figure(svg)


def draw_color_scale(limits: tuple[float, float], unit: str) -> Markup | None:
    """Draw the colours of depth images with their depths."""
    near, far = limits
    if not 0 < near < far < math.inf:
        return None
    text = f"From {near:.3g} to {far:.3g} {unit} on a logarithmic scale; grey means no depth."
    svg = create_figure("Depth colours", text, WIDTH, 44.0, "scale")
    wide = WIDTH - 88
    for k, colour in enumerate(
        make_palette()[np.linspace(1, 255, NUM_PATCHES).astype(int)].tolist()
    ):
        draw_patch(svg, k * wide / NUM_PATCHES, wide / NUM_PATCHES + 0.5, colour)
    for share, anchor in ((0.0, "start"), (0.5, "middle"), (1.0, "end")):
        depth = near * (far / near) ** share
        tick = f"{depth:.3g} {unit}" if share == 1 else f"{depth:.3g}"
        add_label(svg, tick, "tick", share * wide, 30.0, anchor)
    draw_patch(svg, wide + 16, 14.0, NO_DEPTH_COLOR)
    add_label(svg, "no depth", "tick", wide + 34, 12.0)
    return serialize_figure(svg)


def draw_patch(svg: Element, x: float, width: float, colour: Sequence[int]) -> None:
    """Draw a patch of a colour scale."""
    fill = "#{:02x}{:02x}{:02x}".format(*colour)
    add_element(
        svg, "rect", x=x, y=0.0, width=width, height=14.0, fill=fill, shape_rendering="crispEdges"
    )
