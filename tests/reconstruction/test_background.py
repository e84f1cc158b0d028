"""A uniform background that nobody knows: eliminated in every solver's data term."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

import thincam_jax as tc
from helpers import finite_difference, quick
from thincam_jax.imaging.operators import CropConvolution, Matrix, Separable
from thincam_jax.imaging.operators.low_rank import LowRank
from thincam_jax.imaging.targets import middle_square, resize, sample_image
from thincam_jax.reconstruction import solve_fixed_point
from thincam_jax.reconstruction.backgrounds import darkest, with_other_background
from thincam_jax.reconstruction.closed_normal import LevelledNormal
from thincam_jax.reconstruction.implicit_gradient import NeumannSeries
from thincam_jax.reconstruction.normal_equations import normal_equations
from thincam_jax.reconstruction.problem import (
    InverseProblem,
    gradient,
    objective,
    scene_level,
    total_misfit,
    uniform_level,
    with_background,
)
from thincam_jax.reconstruction.ridge import solve_ridge
from thincam_jax.reconstruction.splittings import splitting_of

RNG = np.random.default_rng(65)
SHAPE = (11, 14)  # of the sensor
VALID = RNG.random((2, *SHAPE)) > 0.1


def scene():
    """A disc and a bar, dark around them, on the field of PSFs of 5×6."""
    y, x = np.indices((15, 19)) - np.array([[[7]], [[8]]])
    return 1.0 * (np.hypot(y, x) < 4) + 0.7 * ((abs(y - 3) < 2) & (abs(x) < 7))


def recording(offsets=(0.0, 0.0), noise=1e-3, **known):
    """Two captures of the scene with backgrounds, some of their pixels dead."""
    psfs = tc.Psfs(np.random.default_rng(1).random((2, 5, 6)) ** 3)
    blank = tc.Recording(np.zeros((2, *SHAPE)), psfs, noise_variance=noise**2, background=0.0)
    image = jnp.asarray(scene())[None, None]
    seen = [np.asarray(operator(image))[0] for operator in blank.problem().operators]
    drawn = noise * np.random.default_rng(2).standard_normal((2, *SHAPE))
    seen = np.stack(seen) + drawn + np.reshape(offsets, (2, 1, 1))
    return tc.Recording(
        np.where(VALID, seen, 1e6), psfs, noise_variance=noise**2, valid=VALID, **known
    )


def dense(problem):
    """(A, w, g) of all captures by columns."""
    units = jnp.eye(np.prod(problem.image_shape)).reshape(-1, *problem.image_shape)
    rows = [jax.vmap(o)(units).reshape(len(units), -1).T for o in problem.operators]
    weights = [jnp.broadcast_to(w, c.shape).ravel() for w, c in _parts(problem)]
    captures = [c.ravel() for c in problem.captures]
    return [np.asarray(jnp.concatenate(parts)) for parts in (rows, weights, captures)]


def _parts(problem):
    return zip(problem.weights, problem.captures, strict=True)


@pytest.mark.parametrize(("offsets", "least"), [((9.0, -1.0), -np.inf), ((9.0, 0.1), 0.0)])
def test_the_misfit_is_the_least_over_all_backgrounds(offsets, least):
    """By scipy: a number for each capture, by weights, dead pixels left out.

    It may be negative where captures are; in the second case the image is too bright for one.
    """
    problem = recording(offsets).problem()
    matrix, weights, captures = dense(problem)
    image = 2 * np.random.default_rng(3).random(problem.image_shape)
    missing = matrix @ image.ravel() - captures
    levels, root = np.kron(np.eye(2), np.ones((np.prod(SHAPE), 1))), np.sqrt(weights)
    best = scipy.optimize.lsq_linear(
        root[:, None] * levels, -root * missing, bounds=(least, np.inf), method="bvls"
    )
    assert (best.x > 0).tolist() == [True, False]
    np.testing.assert_allclose(total_misfit(jnp.asarray(image), problem), best.cost, rtol=1e-9)
    expected = matrix.T @ (weights * (missing + levels @ best.x))
    found = np.ravel(gradient(problem, jnp.asarray(image)))
    np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())


def test_ridge_solves_for_image_and_backgrounds():
    problem = recording((3.0, -1.0)).problem()
    matrix, weights, captures = dense(problem)
    levels = np.kron(np.eye(2), np.ones((np.prod(SHAPE), 1)))
    both = np.concatenate([matrix, levels], axis=1)
    prior = np.diag([30.0] * matrix.shape[1] + [0.0, 0.0])
    normal = both.T @ (weights[:, None] * both) + prior
    exact = np.linalg.solve(normal, both.T @ (weights * captures))
    zero = jnp.zeros((1, 1, 1, 1))
    found = solve_ridge(problem, precision=30.0, mean=zero, iterations=5000, tolerance=1e-12)
    np.testing.assert_allclose(np.ravel(found.image), exact[:-2], atol=1e-6)


def test_dense_normal_equations_know_it():
    """The Gram matrix of a `Matrix`, one weight or many, against its application."""
    matrix = RNG.random((20, 12))
    for weight in (2.0, RNG.random((4, 5))):
        operator = Matrix(matrix, (3, 4), (4, 5))
        capture = RNG.random((1, 4, 5))
        problem = InverseProblem(operator, [capture], weights=[weight], background="unknown")
        normal = normal_equations(problem, jnp.asarray(0.3))
        right = jnp.asarray(RNG.random(problem.image_shape))
        np.testing.assert_allclose(normal.applied(normal.solve(right)), right, atol=1e-10)


def separable(weight, background, level=0.0):
    """The problem of a separable camera with a capture of noise."""
    camera = Separable(RNG.random((9, 4)), RNG.random((8, 5)))
    given = {"weights": [weight], "background": background}
    return InverseProblem(camera, [RNG.random((1, 9, 8)) + level], **given)


@pytest.mark.parametrize("weight", [2.0, RNG.random((9, 8))], ids=["one", "many"])
def test_normal_equations_of_one_capture_with_its_background(weight):
    """Solutions against their application; the variance against the dense inverse."""
    problem, shift = separable(weight, "unknown"), jnp.asarray(0.3)
    right = jnp.asarray(RNG.random(problem.image_shape))
    known = normal_equations(with_other_background(problem, "known"), shift)
    levelled = LevelledNormal(problem, known)
    there_and_back = jax.jit(lambda normal: normal.applied(normal.solve(right)))
    for normal in (levelled, levelled.shifted(2 * shift)):
        np.testing.assert_allclose(there_and_back(normal), right, atol=1e-9)
    if np.size(weight) == 1:
        assert isinstance(normal_equations(problem, shift), LevelledNormal)
        matrix, weights, _ = dense(problem)
        both = np.c_[matrix, np.ones(len(matrix))]
        inverse = np.linalg.inv(both.T @ (weights[:, None] * both) + np.diag([0.3] * 20 + [0]))
        found = levelled.variance()
        np.testing.assert_allclose(np.ravel(found), np.diag(inverse)[:-1], rtol=1e-9)


@pytest.mark.parametrize("level", [2.0, -2.0])
@pytest.mark.parametrize("weight", [2.0, RNG.random((9, 8))], ids=["one", "many"])
def test_the_data_of_one_capture_has_a_background_above_zero(weight, level):
    """ADMM's proximal map by scipy, with a background and where it would be negative."""
    splitting = splitting_of(separable(weight, "nonnegative", level))
    state = splitting.start(jnp.asarray(RNG.random((1, 1, 4, 5))))
    (matrix, weights, seen), pull = dense(splitting.problem), splitting.penalties.data**0.5
    root = np.sqrt(weights)
    system = np.block([[root[:, None] * np.c_[matrix, np.ones(72)]], [pull * np.eye(20, 21)]])
    right, least = np.r_[root * seen, pull * state.data[0].ravel()], np.r_[np.full(20, -np.inf), 0]
    exact = scipy.optimize.lsq_linear(system, right, (least, np.inf), "bvls", tol=1e-14).x
    assert (exact[-1] > 0) == (level > 0)
    found = (splitting.reflected(state).data[0] + state.data[0]) / 2
    np.testing.assert_allclose(np.ravel(found), exact[:20], rtol=1e-7, atol=1e-9)


SPOTS = jnp.asarray(RNG.random((2, 12, 13)) ** 6)
CAMERAS = {
    "separable": Separable(RNG.random((24, 9)), RNG.random((28, 12))),
    "dense": Matrix(RNG.random((24 * 28, 9 * 12)), (9, 12), (24, 28)),
    "low rank": LowRank(
        jnp.stack([jnp.ones((9, 12)), jnp.linspace(-0.5, 0.5, 12) * jnp.ones((9, 1))]),
        CropConvolution(
            jnp.asarray(RNG.random((2, 12, 13)) ** 6), 1.0, (24, 28), (9, 12), summed=1
        ),
    ),
}


@pytest.mark.parametrize(
    "solver", quick([tc.Ridge(), tc.AdmmTV(), tc.Fista(), tc.PlugAndPlay()], 0)
)
@pytest.mark.parametrize("camera", quick(CAMERAS, 1))
def test_no_solver_sees_a_background_behind_operators(camera, solver):
    """Levels of a quarter and all of the mean: one image; another, if it is known to be none."""
    operator = CAMERAS[camera]
    truth = resize(sample_image("camera", linear=True), (9, 12))
    light = np.asarray(operator(jnp.asarray(truth)))
    light = light + 0.002 * light.mean() * np.random.default_rng(2).standard_normal(light.shape)
    light, brighter = light + light.mean() / 4, light + light.mean()
    plain, other, wrong = (
        np.asarray(tc.reconstruct(tc.Recording([seen], operator, background=b), solver).image)
        for seen, b in ((light, None), (brighter, None), (brighter, 0.0))
    )
    np.testing.assert_allclose(other, plain, atol=0.01)
    assert np.abs(wrong - plain).max() > 0.1


def test_operators_that_leave_the_brightness_open_have_no_background():
    """Uniform light casts uniform captures through them; nor have captures that are no images."""
    for shape in ((4, 5), (20,)):
        operator = Matrix(np.eye(20), (4, 5), shape)
        found = tc.Recording([RNG.random(shape)], operator, noise_variance=0.01).problem()
        assert not found.has_background


def matrices():
    """A splitting of matrices with two backgrounds ≥ 0, a state of it, and captures."""
    random = np.random.default_rng(4)
    operators = [Matrix(random.random((20, 12)), (3, 4), (4, 5)) for _ in range(2)]
    weights, captures = random.random((2, 2, 1, 4, 5))
    captures = jnp.asarray(captures[0]) + 4, jnp.asarray(captures[1])
    given = {"weights": list(weights), "background": "nonnegative"}
    splitting = splitting_of(InverseProblem(operators, list(captures), **given))
    return splitting, splitting.start(jnp.asarray(random.random((1, 1, 3, 4)))), captures


def test_the_data_of_other_operators_have_backgrounds_above_zero():
    """ADMM's proximal map by scipy, where one of two backgrounds would be negative.

    A map with free ones converged to an image that was no minimum of the objective.
    """
    splitting, state, _ = matrices()
    (matrix, weights, seen), pull = dense(splitting.problem), splitting.penalties.data**0.5
    levels, root = np.kron(np.eye(2), np.ones((20, 1))), np.sqrt(weights)
    system = np.block([[root[:, None] * matrix, root[:, None] * levels], [pull * np.eye(12, 14)]])
    right = np.r_[root * seen, pull * state.data[0].ravel()]
    least = np.r_[np.full(12, -np.inf), 0, 0]
    exact = scipy.optimize.lsq_linear(system, right, (least, np.inf), "bvls", tol=1e-14).x
    assert (exact[12:] > 0).tolist() == [True, False]
    found = jax.jit(lambda state: splitting.reflected(state).data[0] + state.data[0])(state) / 2
    np.testing.assert_allclose(np.ravel(found), exact[:12], rtol=1e-8)


@pytest.mark.thorough
def test_gradients_pass_through_the_data_of_other_operators():
    """They raised an error, for what only decides how conjugate gradients begin and end."""
    splitting, state, captures = matrices()

    @jax.jit
    def data(capture):
        return splitting.with_captures((capture, captures[1])).reflected(state).data[0]

    expected = finite_difference(data, captures[0], jnp.ones_like(captures[0]), 1e-3)
    slope = jax.jacrev(data)(captures[0]).sum(axis=(-3, -2, -1))
    np.testing.assert_allclose(slope, expected, rtol=1e-6, atol=1e-9)


SOLVERS = [
    tc.AdmmTV(2.0, iterations=60),
    tc.PlugAndPlay(),
    tc.Fista(2.0, iterations=60),
    tc.Ridge(0.5, tolerance=1e-8, iterations=3000),
]


@pytest.mark.parametrize("solver", quick(SOLVERS, 0))
def test_no_solver_sees_a_uniform_background(solver):
    """Others for each capture, several times the light: the same image; 0, if 0 is known.

    These PSFs leave the brightness open: near 0 the limit of 0 shows it.
    """
    plain = tc.reconstruct(recording((6.0, 2.0)), solver).image
    other = tc.reconstruct(recording((3.0, 1.0)), solver).image
    size = float(jnp.abs(plain).max())
    np.testing.assert_allclose(other, plain, atol=2e-3 * size)
    wrong = tc.reconstruct(recording((3.0, 1.0), background=0.0), solver).image
    assert float(jnp.abs(wrong - plain).max()) > 0.3 * size


def test_dead_pixels_do_not_hide_the_noise_around_black():
    """Beside pixels of a million noise of 0.001 was none, and the background below black."""
    assert recording().problem().background == "nonnegative"


@pytest.mark.thorough
def test_gradients_pass_through_the_background():
    """Of the minimiser with respect to a capture's pixel, against differences."""
    problem = recording((3.0, -1.0), noise=0.05).problem()
    towards = jnp.asarray(RNG.random(problem.image_shape))

    def projected(value):
        captures = (problem.captures[0].at[0, 5, 6].add(value), problem.captures[1])
        moved = eqx.tree_at(lambda p: p.captures, problem, captures)
        start = jnp.zeros(problem.image_shape)
        found = solve_fixed_point(moved, start, iterations=20000, tolerance=1e-12)
        return jnp.sum(found.image * towards)

    slope, one = jax.grad(projected)(0.0), jnp.asarray(1.0)
    expected = finite_difference(projected, 0 * one, one, 1e-4)
    np.testing.assert_allclose(slope, expected, rtol=1e-3)


@pytest.mark.thorough
def test_where_brightness_is_open_the_darkest_pixel_is_dark():
    """In each channel and plane; a known background determines the brightness, no step is taken."""
    psfs = np.random.default_rng(9).random((1, 2, 3, 4, 4))  # two channels of three planes
    captures = 5 + np.random.default_rng(10).random((1, 2, 9, 12))
    for known in ({}, {"background": 0.0}):
        problem = tc.Recording(captures, tc.Psfs(psfs), noise_variance=1e-2, **known).problem()
        bright = 4 + jnp.asarray(np.random.default_rng(11).random(problem.image_shape))
        found = solve_fixed_point(problem, bright, iterations=0).image
        darkest = bright.min(axis=(-2, -1), keepdims=True)
        np.testing.assert_allclose(found, bright if known else bright - darkest, atol=1e-12)


@pytest.mark.thorough
@pytest.mark.parametrize("share", [None, 0.8])
def test_the_slope_in_tau_with_a_background_to_find(share):
    """A uniform image casts a uniform capture, so that the image's level is a choice: dark is 0.

    Random PSF, and one of a few spots; the image's mean square has the slope of differences.
    """
    psf = np.random.default_rng(7).random((5, 6))
    psf = psf**6 if share is None else 1.0 * (psf > share)
    operator = tc.Recording(np.zeros((1, *SHAPE)), tc.Psfs(psf[None])).problem().operators[0]
    chart = np.zeros((1, 1, 15, 19))
    chart[..., 5:11, 6:14] = 1
    seen = np.asarray(operator(jnp.asarray(chart)))[0]
    seen = seen + 0.02 * seen.max() * np.random.default_rng(8).standard_normal(seen.shape) + 0.3
    given = {"noise_variance": (0.02 * seen.max()) ** 2}

    def found(tau):
        problem = tc.Recording(seen[None], tc.Psfs(psf[None]), **given).problem(tau=tau)
        blank = jnp.zeros(problem.image_shape)
        settings = {"iterations": 4000, "tolerance": 1e-9, "adjoint": NeumannSeries(1e-8, 4000)}
        return solve_fixed_point(problem, blank, **settings).image

    def error(tau):
        return jnp.mean((found(tau) - chart) ** 2)

    slope = float(jax.grad(error)(2.0))
    expected = float(finite_difference(jax.jit(error), jnp.asarray(2.0), jnp.asarray(1.0), 1e-2))
    assert slope == pytest.approx(expected, rel=2e-3)
    assert float(found(2.0).min()) == 0


def test_a_background_above_zero_makes_no_scene_brighter():
    """A dark room: without a bound its level is that of an image of full contrast, 3 times as high.

    `Ridge` takes its prior from it: behind a quarter of a sensor that was 0.6 dB less.
    """
    psf = np.random.default_rng(1).random((1, 7, 6)) ** 6
    blank = tc.Recording(np.zeros((1, 36, 44)), tc.Psfs(psf), noise_variance=1e-4)
    operator = blank.problem().operators[0]
    seen = operator(jnp.zeros(operator.in_shape).at[..., 9:20, 12:30].set(1.0))[None, 0]
    level = {}
    for offset in (0.0, 0.5 * float(seen.mean())):
        found, known = (
            tc.Recording(seen + offset, tc.Psfs(psf), noise_variance=1e-4, background=b).problem()
            for b in (None, 0.0)
        )
        level[offset] = [float(f(found)[0]) for f in (uniform_level, scene_level)]
        assert level[offset][1] == min(level[offset][0], float(scene_level(known)[0]))
    assert level[0.0][0] > 1.5 * level[0.0][1]


@pytest.mark.parametrize("snr_db", [20, 30, 40])
def test_noise_around_black_is_no_background(snr_db):
    """It is sought as not negative, unless the dark frame is several times the noise too bright.

    With a camera that shows how bright an image is (PSFs of a smaller field), any negative pixels
    over 1 % count: there a background that may be negative costs nothing.
    """
    psf = np.random.default_rng(1).random((1, 7, 6)) ** 6
    blank = tc.Recording(np.zeros((1, 36, 44)), tc.Psfs(psf), noise_variance=1.0)
    operator = blank.problem().operators[0]
    seen = operator(jnp.zeros(operator.in_shape).at[..., 9:20, 12:30].set(1.0))[None, 0]
    noise = float(jnp.sqrt(jnp.mean(seen**2))) * 10 ** (-snr_db / 20)
    drawn = noise * np.random.default_rng(2).standard_normal(seen.shape)
    kinds = [
        tc.Recording(seen + drawn - level, tc.Psfs(psf, **field)).problem().background
        for level in (0.0, 4 * noise)
        for field in ({}, {"field_shape": (20, 24)})
    ]
    assert kinds == ["nonnegative", "unknown", "unknown", "unknown"]


def test_a_known_background_is_subtracted():
    """A number, one for each capture, and frames; the captures stay as they were given."""
    plain = recording(background=0.0).problem()
    frames = np.ones((2, *SHAPE)) * np.reshape((3.0, -1.0), (2, 1, 1))
    for offsets, known in (((3.0, 3.0), 3.0), ((3.0, -1.0), frames), ((3.0, -1.0), [3.0, -1.0])):
        seen = recording(offsets, background=known)
        again = dataclasses.replace(seen, noise_variance=1e-6)
        assert float(again.captures[0][VALID[0]][0]) == float(seen.captures[0][VALID[0]][0])
        found = again.problem()
        assert not found.has_background
        image = jnp.ones(plain.image_shape)
        np.testing.assert_allclose(objective(found, image), objective(plain, image), rtol=1e-6)
    with pytest.raises(ValueError, match=r"background has shapes .* give a number or a frame"):
        recording(background=np.zeros((3, 4)))


def test_no_background_is_above_the_darkest_part_of_its_capture():
    """Noise alone does not push the limit below it, and dead pixels do not count."""
    rng, shape = np.random.default_rng(8), (61, 83)
    light = np.clip(np.linspace(-1, 3, 83), 0, 3) * np.ones((61, 1))  # dark on the left
    valid = rng.random(shape) > 0.3
    valid[:8, :8] = False
    captures = [0.5 + light + 0.1 * rng.normal(size=shape) for _ in range(40)]
    parts = [(np.where(valid, c, 1e30)[None], 1.0 * valid) for c in captures]
    highest = np.array([darkest([jnp.asarray(c)], [jnp.asarray(w)]) for c, w in parts])
    assert highest.min() > 0.5 and highest.max() < 0.56


@pytest.mark.parametrize(
    ("kind", "light", "level"),
    [("unknown", 2.0, 0.5), ("unknown", 0.2, 0.2), ("unknown", -1.0, -1.0)]
    + [("nonnegative", 2.0, 0.5), ("nonnegative", -1.0, 0.0), ("known", 2.0, 0.0)],
)
def test_a_background_has_an_upper_limit(kind, light, level):
    difference = jnp.asarray([[-1.0, 1.0], [0.0, 0.0]]) - light  # A f − g: uniform light is missing
    found = with_background(kind, jnp.ones(()), difference, 2, highest=0.5)
    np.testing.assert_allclose(found, difference + level, atol=1e-6)


@pytest.mark.thorough
def test_a_dark_room_takes_no_more_iterations():
    """Behind a PSF that fills the sensor, where uniform light explains a background as well."""
    rng = np.random.default_rng(0)
    waves = np.hypot(*np.meshgrid(*2 * [np.fft.fftfreq(96)], indexing="ij"))
    relief = np.fft.fft2(rng.standard_normal((96, 96))) * np.exp(-400 * waves**2)
    slopes = np.gradient(np.fft.ifft2(relief).real)
    scale = 40 / np.fft.ifft2(relief).real.std()
    y, x = (n + scale * s for n, s in zip(np.indices((96, 96)), slopes, strict=True))
    psf = np.histogram2d(y.ravel(), x.ravel(), np.arange(97) - 0.5)[0]
    optics = tc.Psfs(psf[None] / psf.sum(), field_shape=(191, 191))
    (operator,) = tc.Recording(np.zeros((1, 96, 96)), optics).problem().operators
    page = resize(middle_square(sample_image("page"), 191), (64, 64))
    seen = operator(jnp.asarray(np.pad(page, ((63, 64), (63, 64))))[None, None])[0]
    seen = seen + 0.03 * jnp.std(seen) * jnp.asarray(rng.normal(size=seen.shape))
    known, found = (
        tc.reconstruct(tc.Recording([seen], optics, background=b), tc.AdmmTV()).iterations
        for b in (0.0, None)
    )
    assert found <= known
