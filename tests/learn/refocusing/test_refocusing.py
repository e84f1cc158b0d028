"""Scenes with depth, and a network that is linear estimation and a lens' rendering untrained."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from refocusing_baselines import ControlCode, control_loss, wiener
from refocusing_scores import flat_scene, multiscale_ssim, sub_aperture_capture

import thincam_jax as tc
from thincam_jax.learn.refocusing.cameras import RefocusCamera
from thincam_jax.learn.refocusing.network import NetworkOptions, RefocusNetwork, explain
from thincam_jax.learn.refocusing.planes import Planes
from thincam_jax.learn.refocusing.scenes import (
    LayeredScene,
    SceneOptions,
    captured,
    draw_batch,
    lens_blur,
)
from thincam_jax.learn.refocusing.sources import dead_leaves, photographs
from thincam_jax.learn.refocusing.train import examples, loss, relative_error
from thincam_jax.lensless.forward import imaging_operator
from thincam_jax.units import nm, um

SHAPE = (32, 28)
SMALL = NetworkOptions(steps=2, widths=(8, 8))


@pytest.fixture(scope="module")
def camera() -> RefocusCamera:
    mask = tc.FresnelZoneAperture(beta=3.2, width=5.0)
    thin = tc.LenslessCamera(mask, tc.Sensor((64, 60), 176 * um), 7.5)
    return RefocusCamera(thin, 532 * nm, field_shape=SHAPE, near=50.0, far=200.0, planes=4)


@pytest.fixture(scope="module")
def images():
    return dead_leaves(1, 4, 64)


def draw(camera, images, seed=0, **options):
    return draw_batch(jax.random.key(seed), images, camera, SceneOptions(**options), size=2)


@pytest.mark.thorough
def test_planes_are_the_exact_psfs(camera):
    """What is cut off beside the mask's shadow is little."""
    planes, thin = Planes(camera), camera.camera
    image = jnp.asarray(np.random.default_rng(0).uniform(size=SHAPE))
    for distance in (50.0, 77.0):
        whole = imaging_operator(thin, 532 * nm, distance, field_shape=SHAPE)(image)
        spectrum = planes.spectra_at(jnp.asarray([distance]))[0]
        seen = planes.unit * planes.seen(planes.from_field(image) * spectrum)
        np.testing.assert_allclose(seen, whole, atol=2e-3 * float(whole.max()))


def test_a_stack_has_a_plane_at_any_distance(camera):
    """The others stay evenly spaced in 1/t and in the range; what stands between is shared out."""
    even = camera.inverse_distances
    for distance, number in ((50.0, 0), (77.0, 1), (110.0, 2), (200.0, 3)):
        stand = camera.stand(jnp.asarray(distance))
        assert int(stand.number) == number
        np.testing.assert_allclose(1 / stand.inverse[number], distance)
        assert np.all(np.diff(stand.inverse) < 0)
        assert np.all((stand.inverse >= even[-1] - 1e-12) & (stand.inverse <= even[0] + 1e-12))
        # The commanded plane is the middle one of all places.
        np.testing.assert_array_equal(jnp.argmax(stand.place, axis=0), np.arange(4) - number + 3)
        shares = stand.splat(jnp.linspace(0.002, 0.03, 29)).T
        np.testing.assert_allclose(jnp.sum(shares, axis=1), 1)
        within = jnp.linspace(float(stand.inverse[-1]), float(stand.inverse[0]), 9)
        np.testing.assert_allclose(stand.splat(within).T @ stand.inverse, within)


def test_a_lens_blurs_to_a_disc_of_its_angle(camera):
    """A point's image has the light of the point and the disc's mean square radius, R²/2."""
    point = jnp.zeros((21, 17)).at[10, 8].set(1.0)
    radius = camera.defocus_radius(1 / 60.0 - 1 / 150.0)
    np.testing.assert_allclose(radius, 5.0 * 7.5 * 0.01 / 0.176 / 2, rtol=1e-6)
    disc = lens_blur(point[None], jnp.asarray([4.0]), 6)[0]
    y, x = np.mgrid[-10:11, -8:9].astype(float)
    np.testing.assert_allclose(disc.sum(), 1, atol=1e-12)
    np.testing.assert_allclose(np.sum(disc * (x**2 + y**2)), 8, rtol=0.05)
    np.testing.assert_allclose(lens_blur(point[None], jnp.zeros(1), 6)[0], point, atol=1e-12)


def two_layers(camera, near, far):
    """A bright square before an even ground."""
    cover = jnp.zeros((3, *SHAPE)).at[1, 10:20, 8:18].set(1.0).at[2].set(1.0)
    radiance = jnp.zeros((3, *SHAPE)).at[1].set(1.0).at[2].set(0.5)
    share = jnp.zeros((3, 3, *SHAPE)).at[:, 1].set(1.0)
    inverse = jnp.broadcast_to(1 / jnp.asarray([near, near, far])[:, None], (3, 3))
    return LayeredScene(radiance, cover, share, inverse)


@pytest.mark.thorough
def test_layers_hide_each_other(camera):
    scene = two_layers(camera, 60.0, 150.0)
    np.testing.assert_allclose(scene.all_in_focus[12, 12], 1.0)
    np.testing.assert_allclose(scene.all_in_focus[2, 2], 0.5)
    np.testing.assert_allclose(1 / scene.inverse_map[12, 12], 60.0)
    np.testing.assert_allclose(1 / scene.inverse_map[2, 2], 150.0)
    # Focused on the front its edge is sharp, and the light of an even ground stays as it is.
    near = scene.focused(camera, 1 / 60.0)
    np.testing.assert_allclose(near[10:20, 8:18], 1.0, atol=1e-9)
    np.testing.assert_allclose(near[9, 12], 0.5, atol=1e-9)
    # Focused on the back the front spreads over it and hides as much as it spreads.
    far = scene.focused(camera, 1 / 150.0)
    assert 0.5 < float(far[9, 12]) < 1.0
    assert float(far.max()) <= 1 + 1e-9
    # All of what reaches the mask is in front of it, once.
    emission = scene.emission(camera)
    assert emission.shape == (3, 3, *SHAPE)
    np.testing.assert_allclose(jnp.sum(emission[2], axis=0)[15, 13], 0, atol=1e-9)
    seen = captured(camera, emission, scene.inverse)
    np.testing.assert_allclose(
        seen, camera.operator(1 / scene.inverse[1:, 1])(jnp.sum(emission[1:], axis=1)), atol=1e-9
    )


@pytest.mark.thorough
def test_untrained_it_renders_the_linear_estimate_of_all_planes(camera, images):
    """What a lens sees of the estimate, in the capture's unit and with its light."""
    network = RefocusNetwork.create(camera, SMALL, key=jax.random.key(0))
    batch = draw(camera, images)
    distances = jnp.asarray([60.0, 120.0])
    sweep = network.sweep(batch.capture, distances, batch.deviation)
    assert sweep.shape == (2, 2, *SHAPE)
    # A bright capture beside another changes nothing, and its own image is as much brighter.
    gains = jnp.asarray([1.0, 100.0])
    brighter = batch.capture * gains[:, None, None]
    scaled = network.sweep(brighter, distances, gains * batch.deviation)
    np.testing.assert_allclose(scaled, sweep * gains[:, None, None], rtol=1e-4, atol=1e-4)
    # Compiled as within the sweep: pixel averages of traced numbers have fewer nodes.
    one = eqx.filter_jit(explain)(network, batch.capture[0], batch.deviation[0], distances[0])
    difference = one.stand.inverse - 1 / distances[0]
    stack, radius = one.cleaned.stack, camera.defocus_radius(difference)
    blurred = lens_blur(stack, radius, camera.largest_blur)
    np.testing.assert_allclose(sweep[0, 0], one.mean * jnp.sum(blurred, axis=0), atol=1e-9)
    mean = jnp.mean(batch.all_in_focus[0])
    assert abs(float(one.mean / mean) - 1) < 0.3
    # The stack explains the capture but for its noise, and for what the linear estimate shrinks.
    assert float(one.consistency) < 5


@pytest.mark.thorough
def test_what_it_is_trained_on_is_what_it_does(camera, images):
    """The loss of examples is that of the images which the network gives for their captures."""
    network = RefocusNetwork.create(camera, SMALL, key=jax.random.key(0))
    batch = draw(camera, images)
    given = examples(network, batch)
    errors = []
    for n in range(2):
        found = network.focus(batch.capture[n], batch.commanded[n], batch.deviation[n])
        unit = jnp.mean(batch.image[n]) / jnp.mean(given.image[n])
        errors.append(relative_error(found / unit, given.image[n]))
    parts = loss(network.weights.prior[-1], given)[1]
    np.testing.assert_allclose(parts["focus"], jnp.mean(jnp.stack(errors)), rtol=1e-6)
    # A scene in a mirror is captured as in a mirror.
    turned = given.mirrored(jnp.asarray(True), jnp.asarray(False))
    np.testing.assert_array_equal(turned.images[0], given.images[0][:, ::-1])
    flipped = network.focus(batch.capture[1][::-1], batch.commanded[1], batch.deviation[1])
    np.testing.assert_allclose(flipped, found[::-1], atol=1e-6)


@pytest.mark.thorough
def test_a_network_is_trained_and_explains_its_captures(camera, images):
    network = RefocusNetwork.create(camera, SMALL, key=jax.random.key(0))
    only: dict = {"distances": (60.0, 120.0)}
    batch = draw(camera, images, snr_db=(40.0, 40.0), poisson=0.0, layers=(1.0, 0.0, 0.0), **only)
    assert set(np.round(np.asarray(batch.commanded), 6)) <= {60.0, 120.0}
    network = network.first(1)
    given = examples(network, batch)
    prior, losses = network.weights.prior[0], []
    step, state = make_step(prior)
    for _ in range(12):
        prior, state, value = step(prior, state, given)
        losses.append(float(value))
    assert np.isfinite(losses).all() and losses[-1] < losses[0] - 0.1
    trained = network.with_prior(0, prior)
    maps = trained.distance(batch.capture, batch.deviation)
    assert maps.distance.shape == (2, *SHAPE)
    assert np.all((maps.confidence >= 0) & (maps.confidence <= 1))
    sweep = trained.sweep(batch.capture, jnp.asarray([60.0, 120.0]), batch.deviation)
    alone = trained.focus(batch.capture[1], 120.0, batch.deviation[1])
    np.testing.assert_allclose(sweep[1, 1], alone, atol=1e-7)
    # The image scales with the capture.
    scaled = trained.focus(100 * batch.capture[1], 120.0, 100 * batch.deviation[1])
    np.testing.assert_allclose(scaled, 100 * alone, atol=1e-5)
    assert np.all(trained.consistency(batch.capture, batch.deviation) < 10)


@pytest.mark.thorough
def test_a_simulator_by_parts_of_the_mask_agrees_where_nothing_is_hidden(camera):
    """It shares the optics; what is hidden it finds another way."""
    rng = np.random.default_rng(3)
    picture, cover = rng.uniform(size=SHAPE), np.zeros(SHAPE)
    cover[10:20, 8:18] = 1
    alone = flat_scene(camera, [picture], [np.ones(SHAPE)], [80.0])
    by_parts = sub_aperture_capture(camera, alone, 3)
    clean = captured(camera, alone.emission(camera), alone.inverse)
    np.testing.assert_allclose(by_parts, clean, atol=1e-9 * float(clean.max()))
    # An even scene behind a black screen: the light that passes is about the same.
    both = flat_scene(camera, [0 * picture, 1 + 0 * picture], [cover, np.ones(SHAPE)], [60, 150.0])
    by_parts = sub_aperture_capture(camera, both, 3)
    clean = captured(camera, both.emission(camera), both.inverse)
    np.testing.assert_allclose(by_parts.sum(), clean.sum(), rtol=5e-3)
    assert float(jnp.max(jnp.abs(by_parts - clean))) < 0.05 * float(clean.max())


@pytest.mark.thorough
def test_a_control_code_is_the_filter_at_the_middle_until_it_is_trained(camera, images):
    """Then it focuses by the code: the loss falls, and near and far differ."""
    batch, planes = draw(camera, images), Planes(camera)
    capture, deviation = batch.capture[0], batch.deviation[0]
    code = ControlCode.create(camera, (8, 8), key=jax.random.key(0))
    near, far = (code.focus(capture, jnp.asarray(t), deviation) for t in (50.0, 200.0))
    linear = wiener(planes, capture, deviation, camera.middle)
    np.testing.assert_array_equal(near, far)
    np.testing.assert_allclose(near, linear, atol=0.02 * float(linear.max()))
    weights, rest = eqx.partition(code, eqx.is_inexact_array)

    def of(weights, batch):
        return control_loss(eqx.combine(weights, rest), batch)

    step, state = make_step(weights, of)
    values = []
    for _ in range(30):
        weights, state, value = step(weights, state, batch)
        values.append(float(value))
    assert values[-1] < values[0] - 0.05
    trained = eqx.combine(weights, rest)
    near, far = (trained.focus(capture, jnp.asarray(t), deviation) for t in (50.0, 200.0))
    assert float(jnp.abs(near - far).max()) > 1e-3 * float(linear.max())


def make_step(prior, of=loss):
    adam = optax.scale_by_adam()

    @eqx.filter_jit
    def step(prior, state, given):
        (value, _), slope = jax.value_and_grad(of, has_aux=True)(prior, given)
        with jax.numpy_dtype_promotion("standard"):
            updates, state = adam.update(slope, state)
        return jax.tree.map(lambda w, u: w - 3e-3 * u, prior, updates), state, value

    return step, adam.init(prior)


def test_multiscale_ssim_is_that_of_the_formula():
    """Wang et al. 2003, each window summed by itself; and equal images have 1."""
    rng = np.random.default_rng(1)
    target = rng.uniform(size=(24, 30))
    image = 0.7 * target + 0.2 * rng.uniform(size=target.shape) + 0.05
    y, x = np.mgrid[-5:6, -5:6]
    window = np.exp(-(x**2 + y**2) / (2 * 1.5**2))
    window /= window.sum()

    def means(f, g):
        luminance, structure = [], []
        for i, j in np.ndindex(f.shape[0] - 10, f.shape[1] - 10):
            a, b = f[i : i + 11, j : j + 11], g[i : i + 11, j : j + 11]
            m, n = np.sum(window * a), np.sum(window * b)
            both = np.sum(window * (a - m) * (b - n))
            spread = np.sum(window * ((a - m) ** 2 + (b - n) ** 2))
            structure.append((2 * both + 9e-4) / (spread + 9e-4))
            luminance.append((2 * m * n + 1e-4) / (m**2 + n**2 + 1e-4) * structure[-1])
        return np.mean(structure), np.mean(luminance)

    halves = [f.reshape(12, 2, 15, 2).mean(axis=(1, 3)) for f in (image, target)]
    fine, coarse = 0.0448 / 0.3304, 0.2856 / 0.3304
    wanted = means(image, target)[0] ** fine * means(*halves)[1] ** coarse
    np.testing.assert_allclose(multiscale_ssim(image, target), wanted, rtol=1e-9)
    np.testing.assert_allclose(multiscale_ssim(target, target), 1)


def test_a_device_among_the_photographs_is_refused(tmp_path):
    (tmp_path / "zero.png").symlink_to("/dev/zero")
    with pytest.raises(OSError, match="a device or a pipe"):
        photographs(tmp_path, 32)
