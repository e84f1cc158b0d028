"""A refocusing network (docs/guide/refocusing.md) against what it has to beat, in one table.

`python score_refocusing.py NETWORK IMAGES TUNING [COUNT]`: a network of `refocus_camera`, such
as "shipped"; a folder of photographs that no weight has seen, and one of the training's, on which
the strengths of the baselines are tuned; how many scenes of each kind. Prints Markdown tables: PSNR
in dB with the half width of its 95 % interval over the photographs, SSIM, MS-SSIM; in the first
ones each photograph with three seeds of the noise, and what the network gains on each other method,
by differences of the same captures. All methods see the same captures. Draws
docs/images/learned_measured.png of pictures that no weight has seen, either.
"""

import sys
import time
from collections.abc import Callable, Iterable
from itertools import cycle
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from refocusing_baselines import wiener
from refocusing_scores import capture_scene, flat_scene, scores, sub_aperture_capture, with_noise
from scipy import ndimage

import thincam_jax as tc
from thincam_jax import learn
from thincam_jax.imaging.targets import middle_square, resize, sample_image
from thincam_jax.learn.refocusing.cameras import RefocusCamera
from thincam_jax.learn.refocusing.scenes import captured, lens_blur
from thincam_jax.learn.refocusing.sources import photographs
from thincam_jax.units import nm, um

STRENGTHS = {"Wiener": (0.03, 0.1, 0.3, 1.0, 3.0), "ADMM-TV": (0.25, 0.5, 1.0, 2.0)}
NEAR, FAR, SNR = 60.0, 120.0, 30.0
SEEDS = (0, 1000, 2000)  # added to the noise's


def refocus_camera(pixels: int = 256) -> RefocusCamera:
    """The camera of configs/learned_refocus.yaml, its sensor divided into so many pixels."""
    mask = tc.FresnelZoneAperture(beta=13.0, width=5.6)
    sensor = tc.Sensor((pixels, pixels), 256 * 44 * um / pixels)
    thin, shape = tc.LenslessCamera(mask, sensor, distance=7.5), (pixels // 2, pixels // 2)
    return RefocusCamera(thin, 500 * nm, field_shape=shape, near=50.0, far=200.0, planes=7)


class Shot(NamedTuple):
    """A scene, its capture, the capture's noise and where its layers stand."""

    scene: Any
    capture: Any
    deviation: Any
    distances: tuple[float, ...]

    def target(self, camera, distance: float):
        return np.asarray(_focused(self.scene, camera, distance))

    def in_focus(self, distance: float):
        """Where the layer at a distance shows: all of it without a layer there."""
        if len(self.distances) == 1 or distance not in self.distances:
            return None
        front = np.asarray(self.scene.cover[-2]) > 0.5
        return front if distance == self.distances[0] else ~front


class Methods:
    """What focuses a shot on a distance, by its name. `camera` is the one they are told of."""

    def __init__(self, network, camera=None):
        self.camera = camera or network.camera
        self.network = network
        if camera is not None:
            planes = type(network.planes)(camera)
            self.network = eqx.tree_at(lambda n: n.planes, network, planes)
        self.strength = {"Wiener": 0.3, "ADMM-TV": 2.0}

    def wiener(self, shot: Shot, distance: float):
        strength = jnp.asarray(self.strength["Wiener"], jnp.float32)
        planes = self.network.planes
        return _wiener(planes, shot.capture, shot.deviation, jnp.float32(distance), strength)

    def admm(self, shot: Shot, distance: float):
        """The whole scene taken to stand there."""
        return self._planes(shot, (distance,))

    def oracle(self, shot: Shot, distance: float):
        """Told where the planes stand; what a lens sees of them is rendered."""
        stack = jnp.asarray(self._planes(shot, shot.distances))
        stack = stack.reshape(-1, *self.camera.field_shape)
        difference = 1 / jnp.asarray(shot.distances) - 1 / distance
        radius = self.camera.defocus_radius(difference)
        return jnp.sum(lens_blur(stack, radius, self.camera.largest_blur), axis=0)

    def learned(self, shot: Shot, distance: float):
        return self.network.focus(shot.capture, distance, shot.deviation)

    def _planes(self, shot: Shot, distances):
        cameras = tc.Cameras(
            [self.camera.camera],
            wavelength=float(self.camera.light.wavelengths[0]),
            object_distance=distances[0] if len(distances) == 1 else list(distances),
            field_shape=self.camera.field_shape,
        )
        variance = float(shot.deviation) ** 2
        recording = tc.Recording([shot.capture], cameras, noise_variance=variance)
        solver = tc.AdmmTV(tau=self.strength["ADMM-TV"], iterations=150)
        return np.asarray(tc.reconstruct(recording, solver).image)[..., ::-1, ::-1]


@eqx.filter_jit
def _focused(scene, camera, distance):
    return scene.focused(camera, 1 / distance)


_wiener = jax.jit(wiener)


@eqx.filter_jit
def _taken(camera, scene, noise, key):
    return capture_scene(camera, scene, noise, key)


def shoot(camera, scene, distances, seed: int, snr: float = SNR) -> Shot:
    noise = tc.GaussianNoise(jnp.float32(snr))
    return Shot(scene, *_taken(camera, scene, noise, jax.random.key(seed)), distances)


def one_plane(camera, picture, distance: float, seed: int, snr: float = SNR) -> Shot:
    scene = flat_scene(camera, [picture], [np.ones(camera.field_shape)], [distance])
    return shoot(camera, scene, (distance,), seed, snr)


def two_planes(camera, pair, cover, seed: int, distances=(NEAR, FAR), snr: float = SNR) -> Shot:
    """The first of two pictures, where the cover is, before the second."""
    covers = [cover, np.ones(camera.field_shape)]
    scene = flat_scene(camera, pair, covers, distances)
    return shoot(camera, scene, distances, seed, snr)


def rectangle(shape, seed: int) -> np.ndarray:
    """A turned rectangle somewhere in the middle of the frame."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
    down, across = (rng.uniform(0.3, 0.7) * n for n in shape)
    angle = rng.uniform(0, np.pi)
    u = (x - across) * np.cos(angle) + (y - down) * np.sin(angle)
    v = (y - down) * np.cos(angle) - (x - across) * np.sin(angle)
    return 1.0 * ((abs(u) < 0.3 * max(shape)) & (abs(v) < 0.2 * max(shape)))


def halves(
    camera, pairs, is_left: bool, seed: int = 200, distances=(NEAR, FAR), snr: float = SNR
) -> list[Shot]:
    """The left half of the frame near, or all of that in a mirror, with the same seeds."""
    rows, columns = camera.field_shape
    cover = np.broadcast_to(1.0 * (np.arange(columns) < columns // 2), (rows, columns))
    turn = slice(None, None, 1 if is_left else -1)
    return [
        two_planes(camera, [p[:, turn] for p in pair], cover[:, turn], seed + n, distances, snr)
        for n, pair in enumerate(pairs)
    ]


def tune(methods: Methods, pictures, count: int, distances=(NEAR, FAR, 180.0)) -> None:
    """The strength of each baseline that is best on the training's own images, in one plane."""
    shots = [
        one_plane(methods.camera, picture, t, 900 + n)
        for n, picture, t in zip(range(count), cycle(pictures), cycle(distances), strict=False)
    ]
    for name, run in (("Wiener", methods.wiener), ("ADMM-TV", methods.admm)):
        found = {}
        for strength in STRENGTHS[name]:
            methods.strength[name] = strength
            found[strength] = np.mean([_psnr(methods, run, s, s.distances[0]) for s in shots])
        methods.strength[name] = max(found, key=lambda s: found[s])
        print(f"{name}: strength {methods.strength[name]:g} of {list(found)}", flush=True)


def _psnr(methods: Methods, run: Callable, shot: Shot, distance: float) -> float:
    return scores(run(shot, distance), shot.target(methods.camera, distance))["psnr"]


def head(columns: Iterable[str]) -> None:
    """The head of a table."""
    names = ["test", *columns]
    print("\n| " + " | ".join(names) + " |\n|" + "---|" * len(names))


def row(
    name: str, camera, runs: dict[str, Callable], shots: list[Shot], distance: float, seeds: int = 1
) -> np.ndarray:
    """One line of the table. With seeds, a last column: the gain of the last method on each other.

    `seeds`: so many shots of each scene, all scenes of a seed after those of the one before.
    Returns the PSNR, (method, shot).
    """
    cells, means, qualities = [], [], []
    for run in runs.values():
        each = []
        for shot in shots:
            region = shot.in_focus(distance)
            found = scores(run(shot, distance), shot.target(camera, distance), region)
            each.append((found["psnr"], found["ssim"], found["ms_ssim"]))
        quality, similarity, multiscale = np.transpose(each)
        qualities.append(quality)
        means.append(quality.reshape(seeds, -1).mean(axis=0))
        told = f"{similarity.mean():.3f} / {multiscale.mean():.3f}"
        cells.append(f"{interval(means[-1])} / {told}")
    if seeds > 1:
        cells.append(", ".join(interval(means[-1] - mean, "+") for mean in means[:-1]))
    print(f"| {name} | " + " | ".join(cells) + " |", flush=True)
    return np.stack(qualities)


def interval(values: np.ndarray, sign: str = "") -> str:
    """The mean and half of its 95 % interval."""
    return f"{values.mean():{sign}.2f} ± {1.96 * values.std(ddof=1) / len(values) ** 0.5:.2f}"


def table(network, pictures, tuning, count: int) -> None:
    """All lines."""
    methods, camera = Methods(network), network.camera
    shape = camera.field_shape
    tune(methods, tuning, min(count, 6))
    runs = {"Wiener": methods.wiener, "ADMM-TV": methods.admm, "oracle": methods.oracle}
    runs["network"] = methods.learned
    fast = {"Wiener": methods.wiener, "network": methods.learned}
    single = {name: run for name, run in runs.items() if name != "oracle"}  # it is ADMM-TV then
    rows, count = range(count), len(pictures)
    gains = "gains on each"
    head([*single, gains])
    for t in (NEAR, 85.0, FAR, 170.0):
        shots = [one_plane(camera, pictures[n % count], t, n + s) for s in SEEDS for n in rows]
        row(f"one plane, {t:g} mm", camera, single, shots, t, len(SEEDS))
    head([*runs, gains])
    pairs = [(pictures[n % count], pictures[-1 - n % count]) for n in rows]
    hiding = [
        two_planes(camera, p, rectangle(shape, n), 100 + n + s)
        for s in SEEDS
        for n, p in enumerate(pairs)
    ]
    for t, name in ((NEAR, "near"), (FAR, "far")):
        row(f"two planes, {name}", camera, runs, hiding, t, len(SEEDS))
    hiding = hiding[: len(pairs)]
    times(runs, hiding[0])
    picture(methods)
    swept(methods, hiding)
    head(fast)
    for is_left in (True, False):
        shots = halves(camera, pairs, is_left)
        for t, name in ((NEAR, "near"), (FAR, "far")):
            row(f"near half {'left' if is_left else 'right'}, {name}", camera, fast, shots, t)
    for t in np.round(1 / np.linspace(1 / 52, 1 / 190, 15), 1):
        shots = [one_plane(camera, pictures[n % count], float(t), 300 + n) for n in rows]
        row(f"sweep, {t:g} mm", camera, fast, shots, float(t))
    for t in (NEAR, 100.0, 170.0):
        for snr in (20.0, 25.0, 35.0, 45.0):
            shots = [one_plane(camera, pictures[n % count], t, 400 + n, snr) for n in rows]
            row(f"{t:g} mm, {snr:g} dB", camera, fast, shots, t)
        shots = [photons(s, 500 + n, camera) for n, s in enumerate(shots)]
        row(f"{t:g} mm, 100 electrons", camera, fast, shots, t)
    row("two planes, rendered by sub-apertures, near", camera, fast, apart(camera, hiding), NEAR)
    row("two planes, rendered by sub-apertures, far", camera, fast, apart(camera, hiding), FAR)
    errors(network, methods, pictures, rows)


def swept(methods: Methods, shots: list[Shot]) -> None:
    """How far the two planes that the network finds stand from the true ones.

    Found are the two highest peaks, a depth of focus apart, of the density of 1/t over the pixels,
    each by its confidence.
    """
    camera, network = methods.camera, methods.network
    focus, errors = depth_of_focus(camera), []
    axis = np.linspace(1 / float(camera.far), 1 / float(camera.near), 2000)
    for shot in shots:
        found = network.distance(shot.capture, shot.deviation)
        inverse, sure = 1 / np.ravel(found.distance), np.ravel(found.confidence)
        counts, _ = np.histogram(inverse, len(axis), (axis[0], axis[-1]), weights=sure)
        density = ndimage.gaussian_filter1d(counts, focus / 8 / (axis[1] - axis[0]))
        first = axis[density.argmax()]
        second = axis[np.where(abs(axis - first) > focus, density, 0).argmax()]
        pairs = zip(sorted((first, second)), sorted(1 / np.asarray(shot.distances)), strict=True)
        errors.append([abs(a - b) / focus for a, b in pairs])
    far, near = np.median(errors, axis=0)
    within = np.mean(np.asarray(errors) < 0.25)
    print(
        f"\nplanes found, parts of a depth of focus: near {near:.2f}, far {far:.2f} in the median;"
    )
    print(f"within a quarter {within:.0%}", flush=True)


def depth_of_focus(camera) -> float:
    """Of 1/t, 1/mm, for the finest detail."""
    thin = camera.camera
    radius = float(thin.mask.extent[1]) / 2
    return np.pi / float(thin.mask.beta * thin.distance) / radius**2


def photons(shot: Shot, seed: int, camera) -> Shot:
    """The same scene with shot noise of 100 electrons per pixel in the mean."""
    clean = captured(camera, shot.scene.emission(camera), shot.scene.inverse)
    noise = tc.PoissonGaussianNoise(0.0)
    seen = with_noise(clean, noise, jax.random.key(seed), jnp.float32(100.0))
    return Shot(shot.scene, *seen, shot.distances)


def apart(camera, shots: list[Shot]) -> list[Shot]:
    """The same scenes, captured by sub-apertures."""
    noise, found = tc.GaussianNoise(SNR), []
    for n, shot in enumerate(shots):
        clean = sub_aperture_capture(camera, shot.scene)
        found.append(
            Shot(shot.scene, *with_noise(clean, noise, jax.random.key(600 + n)), (NEAR, FAR))
        )
    return found


def errors(network, methods: Methods, pictures, rows) -> None:
    """What is told is wrong: the distance by parts of a depth of focus, β and d by 1 %."""
    camera = network.camera
    shots = [one_plane(camera, pictures[n % len(pictures)], 100.0, 700 + n) for n in rows]
    focus = depth_of_focus(camera)
    fast = {"Wiener": methods.wiener, "ADMM-TV": methods.admm, "network": methods.learned}
    head(fast)
    row("nothing told wrong", camera, fast, shots, 100.0)
    for part in (0.25, 0.5, 1.0, 2.0):
        told = 1 / (1 / 100.0 + part * focus)
        wrong = {k: (lambda s, t, run=run, told=told: run(s, told)) for k, run in fast.items()}
        row(f"t off by {part:g} of the depth of focus", camera, wrong, shots, 100.0)
    moved = [s._replace(capture=jnp.roll(s.capture, 2, axis=1)) for s in shots]
    row("centre off by 2 pixels", camera, fast, moved, 100.0)
    for name, where in (("β", lambda c: c.camera.mask.beta), ("d", lambda c: c.camera.distance)):
        other = Methods(network, eqx.tree_at(where, camera, 1.01 * where(camera)))
        other.strength = methods.strength
        wrong = {"Wiener": other.wiener, "ADMM-TV": other.admm, "network": other.learned}
        row(f"{name} told 1 % too large", camera, wrong, shots, 100.0)


def times(runs: dict[str, Callable], shot: Shot) -> None:
    """Seconds of an image, warm."""
    for name, run in runs.items():
        began = time.perf_counter(), time.process_time()
        np.asarray(run(shot, NEAR))
        took = time.perf_counter() - began[0], time.process_time() - began[1]
        print(f"{name}: {took[0]:.2f} s, {took[1]:.2f} s of CPU", flush=True)


def squares(folder: str, camera, side: int) -> list[np.ndarray]:
    """The middle of each photograph at the field's size."""
    rows, columns = camera.field_shape
    top, left = (side - rows) // 2, (side - columns) // 2
    images = photographs(folder, side).images[:, top : top + rows, left : left + columns]
    return list(images.astype(float))


def picture(methods: Methods) -> None:
    """A photograph, a page of text, and one before the other; what the methods make of them."""
    camera = methods.camera
    clock, page = (
        resize(middle_square(sample_image(name, linear=True), 256), camera.field_shape)
        for name in ("clock", "page")
    )
    both = two_planes(camera, (page, clock), rectangle(camera.field_shape, 3), 800)
    shots = [
        (one_plane(camera, clock, 85.0, 801), 85.0),
        (one_plane(camera, page, 85.0, 802), 85.0),
        (both, NEAR),
        (both, FAR),
    ]
    runs = {
        "Wiener": methods.wiener,
        "ADMM-TV, all\nat that distance": methods.admm,
        "ADMM-TV, told\nthe planes": methods.oracle,
        "network": methods.learned,
    }
    figure = Figure(figsize=(10, 8.4), layout="constrained")
    for axes, (shot, distance) in zip(figure.subplots(4, 5), shots, strict=True):
        target = shot.target(camera, distance)
        images = {"lens": target, **{n: np.asarray(r(shot, distance)) for n, r in runs.items()}}
        for ax, (name, image) in zip(axes, images.items(), strict=True):
            level = np.clip(image / np.quantile(target, 0.998), 0, 1)
            ax.imshow(level ** (1 / 2.2), cmap="gray", vmin=0, vmax=1)
            ax.set(xticks=[], yticks=[])
            if shot is shots[0][0]:
                ax.set_title(name, fontsize=10)
            if name != "lens":
                ax.set_xlabel(f"{scores(image, target)['psnr']:.1f} dB", fontsize=9)
        axes[0].set_ylabel(f"focused on {distance:g} mm", fontsize=9)
    figure.savefig(Path(__file__).parents[2] / "docs/images/learned_measured.png", dpi=80)


if __name__ == "__main__":
    path, images, tuned, *more = sys.argv[1:]
    camera = refocus_camera()
    network = learn.RefocusNetwork.load(path, camera)
    side = 5 * max(camera.field_shape) // 4
    pictures, known = (squares(folder, camera, side) for folder in (images, tuned))
    table(network, pictures, known, int(more[0]) if more else 12)
