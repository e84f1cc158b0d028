"""The report of a training: scores, a sweep, scenes, the course of the loss, the images."""

from collections.abc import Mapping, Sequence
from typing import Any

from thincam_jax._core.table import Table
from thincam_jax.commands.learned.config import LearnedConfig
from thincam_jax.commands.report import Page, Part, Picture, pixels_of

_SWEEP = "One capture, focused on the distance above each; one grey scale for all."
_SCENES = (
    "Where it is hatched, the network itself takes its distance to be wrong more often than right."
)


def page(config: LearnedConfig, result: Mapping[str, Any]) -> Page:
    """The page of a finished training; `result` as in training.json."""
    mask, focus, diverged = config.mask, config.focus, result["status"] == "diverged"
    lead = (
        f"A network of {result['learned_numbers']} numbers that refocuses captures of one camera: "
        f"{pixels_of(config.sensor).lower()}, zone aperture of {mask.width:g} mm with β = "
        f"{mask.beta:g} rad/mm² at d = {config.distance:g} mm, λ = {config.wavelength * 1e6:g} nm; "
        f"objects at {focus.nearest:g} to {focus.farthest:g} mm. The file is "
        f"`{result['network']}`."
    )
    scores = (
        _scores(result),
        "Of the scenes of the checks, each with its own noise and commanded distance.",
    )
    sweep = (
        Picture("sweep.png", "Contact sheet of the sweep", _SWEEP),
        Picture("sweep.webp", "Animation of the sweep"),
    )
    training = (
        f"{result['steps']} steps, {result['skipped']} skipped, {result['retreats']} times back at "
        f"half the rate: {result['status']}.",
        Picture("loss.png", "Loss"),
    )
    scenes = Picture("scenes.png", "Scenes and what the network makes of them", _SCENES)
    told = "training met NaN again and again; this is its best until then"
    parts = (
        Part("Scores", scores),
        Part("Sweep", sweep),
        Part("Scenes", (scenes,)),
        Part("Training", training),
        Part("Images", (_images(result["images"]), *config.notes)),
    )
    return Page((lead,), parts, command="train", warnings=(told,) if diverged else ())


def _scores(result: Mapping[str, Any]) -> Table:
    keys = ("focus_psnr_db", "focus_ssim", "all_in_focus_psnr_db", "all_in_focus_ssim")
    compared = {"linear start, untrained": "linear", "trained": "trained"}
    rows = [
        (name, *(result[which].get(key) for key in (*keys, "consistency")))
        for name, which in compared.items()
    ]
    both = (
        f"{name}\n{score}" for name in ("focused", "all in focus") for score in ("PSNR dB", "SSIM")
    )
    return Table(("network", *both, "residual\nover noise"), rows, (2, 3, 2, 3, 2))


def _images(images: Mapping[str, Sequence[Mapping[str, Any]]]) -> Table:
    rows = [
        (entry["name"], use, entry["licence"], f"{entry['sha256'][:16]}…")
        for use, entries in images.items()
        for entry in entries
    ]
    return Table(("image", "use", "licence", "SHA-256"), rows)
