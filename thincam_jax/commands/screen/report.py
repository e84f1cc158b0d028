"""The report of a screen: images beside the thesis' table, errors of the model, calibration."""

from thincam_jax._core.table import Table
from thincam_jax.commands.report import Content, Page, Part, Picture, pixels_of
from thincam_jax.commands.screen.config import CalibrationConfig, ScreenConfig
from thincam_jax.studies.screen import ModelResult, RaySummary, ScreenResult
from thincam_jax.studies.screen_calibration import CalibrationScores, FitScores

_RAYS = (
    "Side view: rays of three pixels through lens, plate (grey) and out to the object; thin lines "
    "go on to the object points of the image and its ghosts, further down with each bounce."
)
_FIELD = (
    "Each pixel is reached by one colour, and its ghosts have a shift of their own: no convolution "
    "describes this camera."
)
_PUBLISHED = (
    "Ours are simulated, the published ones measured: the differences are those of the two, not of "
    "the methods. Times are with compilation, all images together."
)
_COLUMNS = (
    "What the sensor sees of single cells (row, column): columns of the measured matrix, and of "
    "the exact one."
)


def page(
    config: ScreenConfig,
    result: ScreenResult,
    rays: RaySummary,
    calibration: CalibrationScores | None,
    peak: float,
) -> Page:
    """The page of a finished run; `peak`: the most memory it took, GB."""
    right, last = config.models[0].name, config.methods[-1].name
    images = (
        "Targets, what the sensor captures (in the colours of its pixels, turned upright), and "
        f"reconstructions with the model “{right}”."
    )
    lead = (
        f"{pixels_of(config.sensor)} behind a glass of {config.screen.glass_thickness:g} mm; "
        f"{config.object.cells[0]}×{config.object.cells[1]} cells at {config.object.distance:g} "
        f"mm, {config.orders} ghost orders, seed {config.seed}. {peak:.1f} GB of memory at most.",
        Picture("images.png", "Targets, captures, reconstructions", images),
        Picture("rays.png", "Rays in side view", _RAYS),
        Picture("field.png", "Wavelength and ghost shifts over the field", _FIELD),
        _rays(rays),
    )
    scored = f"PSNR after a least-squares gain and offset, by {last}."
    errors = (
        _errors(config, result),
        Picture("models.png", "Reconstructions with wrong models", f"By {last} with each model."),
        Picture("errors.png", "PSNR of targets with each model", scored),
    )
    calibrated = ()
    if calibration is not None and config.calibration is not None:
        calibrated = _calibration(config, config.calibration, calibration)
    parts = (
        Part(
            "Beside the thesis' Table 5.1", (_published(config, result.models[right]), _PUBLISHED)
        ),
        Part("What an error of the model costs", errors, "Errors of the model"),
        Part("Calibration with Hadamard patterns", calibrated, "Calibration"),
        Part("Notes", config.notes),
    )
    return Page(lead, parts)


def _rays(rays: RaySummary) -> str:
    if rays.wavelength_nm is None or rays.guided_angle_deg is None:
        return ""
    colours, angles = rays.wavelength_nm, rays.guided_angle_deg
    ghost = ""
    if rays.first_ghost_down_mm is not None and rays.first_ghost_right_mm is not None:
        down, right = rays.first_ghost_down_mm, rays.first_ghost_right_mm[1]
        ghost = f"; by its first ghost a pixel sees {down[0]:.1f} to {down[1]:.1f} mm further down "
        ghost += f"the object and up to {right:.1f} mm further to the side"
    ended = (f"{kind.replace('_', ' ')} {part} %" for kind, part in rays.status_percent.items())
    return (
        f"{colours[0]:.0f} to {colours[1]:.0f} nm, guided at {angles[0]:.1f}° to {angles[1]:.1f}°"
        f"{ghost}. Rays: {', '.join(ended)}."
    )


def _published(config: ScreenConfig, right: ModelResult) -> Table:
    methods = {name: one.scores for name, one in right.methods.items()}
    rows = []
    for target in config.targets:
        own = [scores.targets[target.name] for scores in methods.values()]
        told = [target.published.get(name) for name in methods]
        published = [
            number for one in told for number in (one and one.psnr_db, one and one.seconds)
        ]
        rows.append((target.name, *(n for one in own for n in (one.psnr_db, one.ssim)), *published))
    seconds = (text for s in methods.values() for text in (f"{s.seconds_per_image:.2f}", ""))
    rows.append(("time for an image, s", *seconds, *[""] * (2 * len(methods))))
    ours = (heading for name in methods for heading in (f"{name}\nPSNR dB", "SSIM"))
    theirs = (h for name in methods for h in (f"published\n{name}, dB", "published\ns"))
    count = 2 * len(methods)
    digits = (*(1, 3) * len(methods), *(1,) * count)
    columns = range(count + 1, 2 * count + 1)
    return Table(("target", *ours, *theirs), rows, digits, published=columns)


def _errors(config: ScreenConfig, result: ScreenResult) -> Table:
    last, targets = config.methods[-1].name, [target.name for target in config.targets]
    right = result.models[config.models[0].name].methods[last].scores.mean_psnr_db
    rows = []
    for name, model in result.models.items():
        scores = model.methods[last].scores
        mean = scores.mean_psnr_db
        loss = None if right is None or mean is None else right - mean
        each = (scores.targets[target].psnr_db for target in targets)
        rows.append((name, *each, mean, loss, model.mistake))
    headings = ("model of the camera", *targets, "mean dB", "loss dB", "what it is")
    return Table(headings, rows, (1,) * (len(targets) + 2), words=(len(targets) + 3,))


def _calibration(
    config: ScreenConfig, asked: CalibrationConfig, found: CalibrationScores
) -> tuple[Content, ...]:
    last, distance = config.methods[-1].name, config.object.distance
    reasons = "".join(f"; {reason}" for reason in found.fit.reasons)
    elsewhere = (
        f"Other distances by {last}: with the exact rays, with a matrix measured there, with that "
        f"of the screen fitted at {distance:g} mm, and with the screen as it was assumed before."
    )
    return (
        f"{found.frames} frames of {asked.bits} bits, {asked.display}, in {asked.order} order. The "
        f"largest entry of the matrix is {found.largest_counts:.0f} counts; its noise is "
        f"{found.noise_counts:.3f}, expected of the frames' {found.expected_noise_counts:.3f}. "
        "“measured matrix” in the tables above is a reconstruction with it.",
        Picture("columns.png", "Columns of the matrix", _COLUMNS),
        f"The screen fitted to it: {found.fit.status.replace('_', ' ')}{reasons}.",
        _fitted(found.fit),
        *((_distances(found),) if found.distances else ()),
        Picture("distances.png", "A target at other distances", elsewhere),
    )


def _fitted(fit: FitScores) -> Table:
    rows = [
        (
            name.replace("_", " "),
            f"{value.found:.5g} {value.unit}",
            f"{value.standard_error:.2g}",
            None if value.true is None else f"{value.true:.5g}",
        )
        for name, value in fit.values.items()
    ]
    return Table(("number", "found", "standard error", "true"), rows)


def _distances(found: CalibrationScores) -> Table:
    ways = next(iter(found.distances.values()))
    rows = [
        (distance, *(way.mean_psnr_db for way in each.values()))
        for distance, each in found.distances.items()
    ]
    headings = ("object at", *(f"{name}, mean dB" for name in ways))
    return Table(headings, rows, (1,) * len(ways))
