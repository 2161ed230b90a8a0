"""The table of docs/recipes.md, from the presets: `python tests/recipe_table.py` writes it anew."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

from cap4d.avatar import deformer, densify, losses, model, trainer
from cap4d.avatar.presets import PRESET_NAMES, RECIPE_NAMES, Preset, preset_named

PAGE = Path(__file__).parents[1] / "docs" / "recipes.md"
BEGIN, END = "<!-- from the presets -->\n", "<!-- to here -->\n"


def count(n: float) -> str:
    """`2500` -> `2.5k`"""
    return f"{n / 1000:g}k" if n >= 1000 else f"{n:g}"


def number(x: float) -> str:
    return "never" if x == math.inf else f"{x:g}".replace("e-0", "e-")


def fall(ends: tuple[float, float]) -> str:
    first, last = map(number, ends)
    return first if first == last else f"{first} → {last}"


def growth(p: Preset) -> str:
    d = p.densify
    steps = [s for s in range(1, p.iterations + 1) if d.grows_at(s)]
    return f"{count(steps[0])}-{count(steps[-1])} by {count(d.every)}"


def resets(p: Preset) -> str:
    d = p.densify
    return f"{count(d.start)}, then by {count(d.reset_every)}" if d.reset_every else "none"


def lpips(p: Preset) -> str:
    t = p.perceptual
    if t.kind == "none":
        return "none"
    return f"0 → {number(t.most)}, step {count(t.start)}-{count(t.stop)}"


ROWS: dict[str, Callable[[Preset], str]] = {
    "optimisation steps, one image each (37)": lambda p: count(p.iterations),
    "longer side of the images, px (42)": lambda p: count(p.image_size),
    "UV grid (16)": lambda p: f"{p.grid_size} x {p.grid_size}",
    "U-Net's first channels (22)": lambda p: str(p.deformer_width),
    "noise on the expressions it sees": lambda p: number(p.expression_noise),
    "first Gaussians (29)": lambda p: count(p.gaussians),
    "at least, on every triangle (29)": lambda p: str(p.per_face),
    "first colours (29)": lambda p: "from the images" if p.paint else "grey",
    "SH degree; steps to each further one (26, 37)": lambda p: f"{p.sh_degree}; {count(p.sh_every)}",
    "growth at steps (37)": growth,
    "above a gradient of, px⁻¹ (37)": lambda p: number(p.densify.gradient),
    "up to, Gaussians": lambda p: "no limit" if p.densify.most is None else count(p.densify.most),
    "split rather than cloned above, m (37)": lambda p: number(p.densify.split_scale),
    "offset of the two halves in (30)": lambda p: f"{p.densify.split_offset} units",
    "pruned below an opacity of (37)": lambda p: number(p.densify.prune_opacity),
    "pruned above, m; px; from step (37)": lambda p: "; ".join(
        (
            number(p.densify.prune_scale),
            number(p.densify.prune_radius),
            count(p.densify.prune_big_after),
        )
    ),
    "opacities lowered at (37)": resets,
    "L1 : 1 - SSIM : squared error (33)": lambda p: " : ".join(
        map(number, (p.weights.l1, p.weights.dssim, p.weights.l2))
    ),
    "share of LPIPS (33)": lpips,
    "its factor (33)": lambda p: number(p.perceptual.weight),
    "LPIPS is shown images in (33)": lambda p: "[-1, 1]" if p.perceptual.image_range == "fixed" else "[0, 1]",
    "matte": lambda p: number(p.weights.matte),
    "means beyond, face sizes (34)": lambda p: (
        f"{number(p.weights.position)} beyond {number(p.weights.position_limit)}"
    ),
    "scales beyond, face sizes (34)": lambda p: (
        f"{number(p.weights.scale)} beyond {number(p.weights.scale_limit)}"
    ),
    "Laplacian of the deformation (35)": lambda p: number(p.weights.laplacian),
    "size of its part by expression (35)": lambda p: number(p.weights.deformation),
    "turning by that part; every so many steps (35)": lambda p: (
        f"{number(p.weights.rotation)}; {p.rotation_every}"
    ),
    "how these three and the means are measured": lambda p: p.weights.measures,
    "corrections of the tracking (32)": lambda p: p.corrections,
    "their penalty (35)": lambda p: number(p.weights.pose),
    "rate of means (36)": lambda p: fall(p.rates.means),
    "of SH, DC; rest (36)": lambda p: f"{fall(p.rates.sh_dc)}; {fall(p.rates.sh_rest)}",
    "of opacities (36)": lambda p: fall(p.rates.opacity),
    "of scales; rotations (36)": lambda p: f"{fall(p.rates.scale)}; {fall(p.rates.rotation)}",
    "of the U-Net; its L2 decay (36)": lambda p: (
        f"{fall(p.rates.deformer)}; {number(p.rates.deformer_decay)}"
    ),
    "of corrections (36)": lambda p: fall(p.rates.correction),
    "Adam's eps: Gaussians; corrections (36)": lambda p: (
        f"{number(p.rates.gaussian_eps)}; {number(p.rates.correction_eps)}"
    ),
}

COMMON = {
    "first local means (29)": f"[0, {number(model.INITIAL_REACH)})³ face sizes",
    "first opacity; scale (29)": f"{number(model.INITIAL_OPACITY)}; 1 / Gaussians of the triangle",
    "unit of a deformation, m (20)": number(deformer.DEFORM_STD),
    "SSIM's window; sigma, px (33)": f"{losses.SSIM_WINDOW}; {number(losses.SSIM_SIGMA)}",
    "opacities are lowered to (37)": number(densify.RESET_OPACITY),
    "a split makes; smaller by (30)": f"{densify.CHILDREN}; {number(densify.SPLIT_SHRINK)}",
    "U-Net's eps of Adam (36)": number(trainer.ADAM_EPS),
    "background (28)": "white" if set(trainer.WHITE) == {1.0} else str(trainer.WHITE),
}


def recipe_table() -> str:
    """Markdown: a row a constant, a column a recipe; where presets differ, all four."""
    lines = ["| | released | paper | short |", "|---|---|---|---|"]
    for label, cell in ROWS.items():
        released, paper, short = ([cell(preset_named(n, r)) for n in PRESET_NAMES] for r in RECIPE_NAMES)
        cells = (written(released), "same" if paper == released else written(paper), written(short))
        lines.append(f"| {label} | {' | '.join(cells)} |")
    lines += ["", "The same in all of them:", "", "| | |", "|---|---|"]
    lines += [f"| {label} | {value} |" for label, value in COMMON.items()]
    return "\n".join(lines) + "\n"


def written(cells: list[str]) -> str:
    return cells[0] if len(set(cells)) == 1 else "<br>".join(cells)


def page_with(table: str) -> str:
    """The page with this table in its place."""
    before, rest = PAGE.read_text().split(BEGIN)
    return before + BEGIN + "\n" + table + "\n" + END + rest.split(END)[1]


if __name__ == "__main__":
    PAGE.write_text(page_with(recipe_table()))
