"""The drawn explanation: a map, and a TAB-Field over time beside the same motion without a mission."""

from __future__ import annotations

import base64
import io
from html import escape

import numpy as np
from numpy.typing import NDArray

from tab_marl.evaluation.report.replay import encode_region
from tab_marl.world.regions import Region
from tab_marl.world.scenario import Scenario

MISSION = "Reach Checkpoint A within 16s"
SCENARIO = "lab"
MOMENTS = (2.0, 6.0, 10.0, 14.0)
"""Seconds shown."""
HEAT_RGB = (124, 58, 200)


def explanation() -> dict[str, str]:
    """SVG and text by name: map, map_text, walk, field, field_text."""
    from tab_marl.field import FieldOptions, FieldProblem, solve
    from tab_marl.field.belief import ProductBelief
    from tab_marl.field.chain import product_chain
    from tab_marl.mission import parse_mission

    scenario = Scenario.preset(SCENARIO)
    mission = parse_mission(MISSION, scenario)
    problem = FieldProblem.from_mission(mission, scenario, FieldOptions(cell_metres=0.05))
    field = solve(problem)
    assert problem.grid is not None
    goal = scenario.region("Checkpoint A")
    ticks = [round(seconds / scenario.step_seconds) for seconds in MOMENTS]
    with_mission = [problem.grid.image(field.occupancy[t], 0.0) for t in ticks]
    # The same motion with nothing to do: h = 1 everywhere.
    free = ProductBelief(product_chain(problem.reference, problem.labels, problem.automaton, problem.start))
    without = []
    for t in range(max(ticks) + 1):
        if t:
            free.predict()
        if t in ticks:
            without.append(problem.grid.image(free.cell_marginal(), 0.0))
    done = [100 * float(field.completion_probability[t]) for t in ticks]
    return {
        "map": draw_map(scenario, [goal], "A map with five checkpoints, four obstacles and both robots", robots=True),
        "map_text": "Checkpoints are lettered; the adversary’s exact start is not known to the ego.",
        "walk": _frames(scenario, goal, without, [""] * len(ticks), "without the mission"),
        "field": _frames(scenario, goal, with_mission, [f"{d:.0f} % done" for d in done], "with the mission"),
        "field_text": f"Mission: “{MISSION}”, {scenario.adversary.max_speed} m/s at most. Darker is likelier, each frame "
        "on its own scale (square root). Nobody told the field which way round the obstacles to go, or when to arrive: "
        "mass goes wherever the mission leaves room, and gathers at the goal as time runs out.",
    }


def _frames(scenario: Scenario, goal: Region, images: list[NDArray[np.float64]], notes: list[str], title: str) -> str:
    parts = ['<div class="frames">']
    for seconds, image, note in zip(MOMENTS, images, notes, strict=True):
        caption = f"{seconds:g} s" + (f", {note}" if note else "")
        picture = draw_map(scenario, [goal], f"Where the adversary may be after {seconds:g} s, {title}", image)
        parts.append(f"<figure>{picture}<figcaption>{escape(caption)}</figcaption></figure>")
    return "".join(parts) + "</div>"


def draw_map(
    scenario: Scenario,
    goals: list[Region],
    title: str,
    heat: NDArray[np.float64] | None = None,
    robots: bool = False,
) -> str:
    """SVG of a map, metres as units; `heat` ``[rows, columns]`` lies under it, row 0 at the bottom."""
    w, h = scenario.width_metres, scenario.height_metres
    parts = [
        f'<svg class="map" viewBox="0 0 {w} {h}" role="img" aria-label="{escape(title)}">',
        f'<rect width="{w}" height="{h}" fill="var(--floor)" stroke="var(--line)" stroke-width=".02"/>',
    ]
    if heat is not None:
        parts.append(
            f'<image width="{w}" height="{h}" preserveAspectRatio="none" href="data:image/png;base64,{heat_png(heat)}"/>'
        )
    parts.append(f'<g transform="translate(0 {h}) scale(1 -1)">')
    for c in scenario.checkpoints:
        parts.append(
            f'<circle cx="{c.x}" cy="{c.y}" r="{c.camera_metres}" fill="var(--camera)" fill-opacity=".1" '
            f'stroke="var(--camera)" stroke-width=".012" stroke-dasharray=".03 .03"/>'
            f'<circle cx="{c.x}" cy="{c.y}" r="{c.radius_metres}" fill="none" stroke="var(--soft)" stroke-width=".015"/>'
        )
    parts += [_shape(o, 'fill="var(--solid)"') for o in scenario.obstacles]
    parts += [_shape(g, 'fill="none" stroke="var(--goal)" stroke-width=".04"') for g in goals]
    if robots:
        (ax, ay), (ex, ey) = scenario.adversary_start.centre, scenario.ego_start.centre
        parts.append(
            f'<circle cx="{ax}" cy="{ay}" r="{scenario.adversary.radius_metres}" fill="var(--adversary)"/>'
            f'<circle cx="{ex}" cy="{ey}" r="{scenario.ego.radius_metres}" fill="var(--ego)"/>'
            f'<circle cx="{ex}" cy="{ey}" r="{scenario.interception_metres}" fill="none" stroke="var(--ego)" '
            'stroke-width=".012" stroke-dasharray=".04 .04"/>'
        )
    parts.append("</g>")
    for c in scenario.checkpoints:
        label = escape(c.name.removeprefix("Checkpoint "))
        parts.append(
            f'<text x="{c.x}" y="{h - c.y + 0.055:.3f}" font-size=".16" font-weight="600" text-anchor="middle" '
            f'fill="var(--soft)">{label}</text>'
        )
    return "".join(parts) + "</svg>"


def _shape(region: Region, style: str) -> str:
    kind, *numbers = encode_region(region)
    if kind == "disc":
        return f'<circle cx="{numbers[0]}" cy="{numbers[1]}" r="{numbers[2]}" {style}/>'
    if kind == "box":
        x0, y0, x1, y1 = numbers
        return f'<rect x="{x0}" y="{y0}" width="{x1 - x0:.4f}" height="{y1 - y0:.4f}" {style}/>'
    points = " ".join(f"{x},{y}" for x, y in numbers[0])
    return f'<polygon points="{points}" {style}/>'


def heat_png(image: NDArray[np.float64]) -> str:
    """Base64 PNG: one colour whose opacity follows the square root of the value over the largest one."""
    from PIL import Image

    values = np.nan_to_num(np.maximum(image, 0.0))[::-1]
    top = float(values.max())
    pixels = np.zeros((*values.shape, 4), dtype=np.uint8)
    pixels[..., :3] = HEAT_RGB
    pixels[..., 3] = np.rint(225 * np.sqrt(values / top)) if top > 0 else 0
    out = io.BytesIO()
    Image.fromarray(pixels).save(out, "PNG", optimize=True)
    return base64.b64encode(out.getvalue()).decode()
