"""Draw `docs/images/frames.svg`: the world frame, a base frame, and which quantities belong to which.

Run without arguments to write, with `--check` to fail when the file is stale.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import generated

OUTPUT = generated.REPOSITORY / "docs" / "images" / "frames.svg"

STYLE = "text{font:14px sans-serif;fill:#223}.n{font-weight:bold}.c{font-family:monospace;font-size:13px}"
AXES = {"x": "#c62828", "y": "#2e7d32", "z": "#1565c0"}


def frame(origin: tuple[float, float], tips: dict[str, tuple[float, float]], name: str) -> list[str]:
    """Draw three arrows from an origin, labelled, with the frame's name below."""
    x, y = origin
    lines = [f'<text class="n" x="{x - 30:g}" y="{y + 34:g}">{name}</text>']
    for axis, (dx, dy) in tips.items():
        colour = AXES[axis]
        lines += [
            f'<line x1="{x:g}" y1="{y:g}" x2="{x + dx:g}" y2="{y + dy:g}" stroke="{colour}" stroke-width="3" '
            f'marker-end="url(#{axis})"/>',
            f'<text x="{x + 1.2 * dx - 4:g}" y="{y + 1.2 * dy + 5:g}">{axis}</text>',
        ]
    return lines


def render() -> str:
    world = {"x": (78, 26), "y": (66, -34), "z": (0, -84)}
    # The base is turned about z and pitched a little, so that the two frames cannot be mistaken for each other.
    base = {"x": (84, -6), "y": (20, -52), "z": (-26, -76)}
    markers = "".join(
        f'<marker id="{axis}" viewBox="0 0 8 8" refX="4" refY="4" markerWidth="4" markerHeight="4" orient="auto">'
        f'<path d="M0 0L8 4L0 8z" fill="{colour}"/></marker>'
        for axis, colour in AXES.items()
    )
    notes = [
        (40, 268, "n", "world frame: right-handed, z up, metres, radians"),
        (40, 290, "c", "root_pos_w, root_quat_w (w, x, y, z), root_lin_vel_w, root_ang_vel_w,"),
        (40, 308, "c", "apply_xfrc(force, torque), location, contacts"),
        (40, 336, "n", "base frame: fixed to the root body"),
        (40, 358, "c", "root_lin_vel_b, root_ang_vel_b, projected_gravity_b, twist_linear, twist_angular"),
    ]
    lines = [
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 760 380" role="img">',
        "<title>World frame and base frame</title>",
        f"<style>{STYLE}</style><defs>{markers}</defs>",
        '<rect width="760" height="380" rx="8" fill="#f7f8fb"/>',
        '<line x1="120" y1="190" x2="480" y2="140" stroke="#889" stroke-width="2" stroke-dasharray="6 5"/>',
        '<text class="c" x="270" y="150">root_pos_w</text>',
        '<g transform="rotate(-4 480 140)"><rect x="440" y="122" width="110" height="36" rx="8" fill="#c9d3ea"/></g>',
        *frame((120, 190), world, "world"),
        *frame((480, 140), base, "base"),
        '<line x1="640" y1="60" x2="640" y2="150" stroke="#555" stroke-width="3" marker-end="url(#z)"/>',
        '<text x="656" y="110">gravity</text>',
        *(f'<text class="{kind}" x="{x}" y="{y}">{text}</text>' for x, y, kind, text in notes),
        "</svg>",
    ]
    return "\n".join(lines) + "\n"


def main(argv: Sequence[str] | None = None) -> int:
    return generated.main("gen_frames.py", argv, lambda: {OUTPUT: render()})


if __name__ == "__main__":
    sys.exit(main())
