"""An episode as one HTML file that needs neither a server nor a network: `wbc-bench replay`."""

import html
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from wbc_bench.files import write_atomic
from wbc_bench.results.formatting import CM, DEG
from wbc_bench.viewer.rerun import EVERY, Rerun
from wbc_bench.viewer.scene import SceneView, serving
from wbc_bench.viewer.time_line import Event, events_of, story_of

CHART = (370, 48)  # [px] width, height of the error chart


def write_html(again: Rerun, path: Path) -> None:
    """Write an episode that has been run again as a page with time control.

    Raises: BenchError without viser; StoreError when the file cannot be written.
    """
    write_atomic(path, page(again).encode())


def page(again: Rerun) -> str:
    """The page of an episode."""
    with serving() as server:
        scene = SceneView(server, again.robot, again.protocol.success)
        moments = again.moments[::EVERY]
        scene.show(moments[0])
        recording = server.get_scene_serializer()
        for before, moment in pairwise(moments):
            recording.insert_sleep(moment.time - before.time)
            scene.show(moment)
        recording.insert_sleep(1.0)  # [s] to look at the end
        text = recording.as_html()
    text = text.replace("<title>Viser</title>", f"<title>{html.escape(again.title)}</title>", 1)
    body = text.rindex("</body>")
    return text[:body] + _caption(again) + text[body:]


def _caption(again: Rerun) -> str:
    """What was seen, how it ended, whether the record agrees, and the errors over time."""
    stored = again.stored
    ends = f"{str(stored['outcome']).replace('_', ' ')} after {again.moments[-1].time:.2f} s"
    facts = [f"<b>{html.escape(again.title)}</b>", html.escape(ends)]
    if stored["stratum"]:
        facts.append(f"stratum {html.escape(str(stored['stratum']))}")
    events = events_of(again)
    facts.append(html.escape(story_of(again, events)))
    style = "color:#1b7f4b" if not again.differences else "color:#a05a00"
    facts.append(f'<span style="{style}">{html.escape(again.verdict)}</span>')
    chart = _chart(again, events)
    return (
        '<div style="position:fixed;top:12px;right:12px;z-index:5;box-sizing:border-box;width:400px;'
        "padding:10px 14px;"
        "background:rgba(255,255,255,.92);border:1px solid #d5d9de;border-radius:6px;color:#1b2330;"
        f'font:13px/1.5 system-ui,sans-serif;pointer-events:none">{"<br>".join(facts)}{chart}</div>'
    )


def _chart(again: Rerun, events: Sequence[Event]) -> str:
    """Position and orientation error over time, each as a part of its largest value; events below."""
    time = np.array([moment.time for moment in again.moments])
    lines, names = [], []
    for name, unit, colour, values in (
        ("position", "cm", "#2864c8", np.array([m.position_error for m in again.moments]) * CM),
        ("orientation", "°", "#b0446e", np.array([m.orientation_error for m in again.moments]) * DEG),
    ):
        most = max(float(values.max()), 1e-9)
        x = time / max(float(time[-1]), 1e-9) * CHART[0]
        y = CHART[1] * (1 - values / most)
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x[::5], y[::5], strict=True))
        lines.append(f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="1.5"/>')
        names.append(f'<span style="color:{colour}">{name} 0–{most:.1f} {unit}</span>')
    line = _time_line(events)
    return (
        f'<svg width="{CHART[0]}" height="{CHART[1] + 2}" style="display:block;margin-top:6px;'
        f'border-bottom:1px solid #b8bec6">{"".join(lines)}</svg>{line}error: {", ".join(names)}'
    )


def _time_line(events: Sequence[Event]) -> str:
    """What happened, as marks below the chart, on its axis of time, and in words."""
    end = max(events[-1].time, 1e-9)
    colours = ["#b03a1e" if event.wrong else "#1b2330" for event in events]
    places = [min(event.time / end * CHART[0], CHART[0] - 3) for event in events]
    marks = "".join(
        f'<rect x="{x:.1f}" width="3" height="10" fill="{colour}"/>'
        for x, colour in zip(places, colours, strict=True)
    )
    words = "".join(
        f'<div style="color:{colour}">{event.time:.2f} s {html.escape(event.text)}</div>'
        for event, colour in zip(events, colours, strict=True)
    )
    return f'<svg width="{CHART[0]}" height="10" style="display:block">{marks}</svg>{words}'
