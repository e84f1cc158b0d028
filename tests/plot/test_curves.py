"""Figures: what is drawn, against the functions that compute it."""

import dataclasses
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from design import small
from studies import tiny
from studies.test_design_result import fronts

import thincam_jax as tc
from thincam_jax import Psfs
from thincam_jax.design import BayesError
from thincam_jax.design.fronts import FrontPoint
from thincam_jax.design.landscape import Landscape
from thincam_jax.design.ranking import RankedDesign
from thincam_jax.design.sensitivity import Derivatives, FreeValue, Sensitivity
from thincam_jax.imaging.operators import Separable
from thincam_jax.plot.design import draw_fronts, draw_objective
from thincam_jax.plot.objects import draw_recording
from thincam_jax.plot.studies import _by_synthesis
from thincam_jax.reconstruction.result import Reconstruction
from thincam_jax.studies.design import FoundDesigns
from thincam_jax.studies.result import Response, ResponseLimits
from thincam_jax.units import nm, um


@pytest.mark.thorough
def test_a_history_shows_what_the_solver_noted():
    random = np.random.default_rng(0)
    recording = tc.Recording(
        random.uniform(size=(1, 12, 16)), Psfs(random.uniform(size=(1, 12, 16)))
    )
    result = tc.reconstruct(recording, tc.AdmmTV(2.0, iterations=20))
    objective, residuals = tc.plot.history(result).axes
    noted = [(entry.iteration, entry.objective) for entry in result.history]
    np.testing.assert_allclose(objective.lines[0].get_xydata(), noted)
    assert [line.get_label() for line in residuals.lines] == ["primal", "dual"]
    closed_form = Reconstruction(jnp.zeros((3, 4)), None, method="wiener")
    with pytest.raises(ValueError, match="by wiener has no iterations; give the result of an iter"):
        tc.plot.history(closed_form)


def test_a_landscape_marks_its_minimum():
    across, down = np.linspace(10, 30, 7), np.linspace(5, 15, 4)
    values = (across - 20) ** 2 + (down[:, None] - 5) ** 2
    labels = ("β₁ (rad/mm²)", "β₂ (rad/mm²)", "error (dB)")
    figure = tc.plot.landscape(values, across, down, labels=labels)
    axes, bar = figure.axes
    assert (axes.get_xlabel(), axes.get_ylabel(), bar.get_ylabel()) == labels
    cross = next(line for line in axes.lines if line.get_marker() == "x")
    np.testing.assert_allclose(cross.get_xydata(), [[20, 5]])
    for wrong in (values.T, np.full_like(values, np.nan)):
        with pytest.raises(ValueError, match=r"give finite values of shape \(4, 7\)"):
            tc.plot.landscape(wrong, across, down, labels=labels)


def test_a_psf_lies_on_the_sensor_in_mm():
    mask = tc.FresnelZoneAperture(25.0, width=1.0)
    camera = tc.LenslessCamera(mask, tc.Sensor((24, 30), 0.05), distance=3.0)
    figure = tc.plot.psf(camera, wavelength=5e-4, model="geometric", pixel_integration=False)
    image, line = figure.axes[:2]
    assert image.images[0].get_extent() == pytest.approx([-0.75, 0.75, 0.6, -0.6])
    expected = tc.psf(camera, wavelength=5e-4, model="geometric", pixel_integration=False)
    np.testing.assert_array_equal(image.images[0].get_array(), expected)
    np.testing.assert_array_equal(line.lines[0].get_ydata(), expected[12])


def test_an_otf_has_axes_in_cycles_per_mm():
    mask = tc.FresnelZoneAperture(25.0, width=1.0)
    camera = tc.LenslessCamera(mask, tc.Sensor((24, 30), 0.05), distance=3.0)
    figure = tc.plot.otf(camera, wavelength=5e-4, model="geometric", pixel_integration=False)
    image, line = figure.axes[:2]
    expected = np.asarray(
        tc.otf(camera, wavelength=5e-4, model="geometric", pixel_integration=False)
    )
    expected = expected / abs(expected[12, 15])
    u, v = np.asarray(camera.sensor.grid.u), np.asarray(camera.sensor.grid.v)
    levels = 20 * np.log10(np.maximum(abs(expected), 1e-6))
    np.testing.assert_allclose(image.images[0].get_array(), levels, atol=1e-9)
    along = np.stack([u[15:], levels[12, 15:]], axis=1)
    np.testing.assert_allclose(line.lines[0].get_xydata(), along, atol=1e-9)
    left, right, bottom, top = image.images[0].get_extent()
    assert (left, right) == pytest.approx((u[0] - (u[1] - u[0]) / 2, u[-1] + (u[1] - u[0]) / 2))
    assert (bottom, top) == pytest.approx((v[-1] + (v[1] - v[0]) / 2, v[0] - (v[1] - v[0]) / 2))


def test_a_mask_lies_in_mm_and_shows_a_phase_where_it_has_one():
    pinhole = tc.Pinhole(0.4, 0.2)
    figure = tc.plot.mask(pinhole, samples=40)
    assert figure.axes[0].images[0].get_extent() == pytest.approx([-0.2, 0.2, 0.1, -0.1])
    assert figure.axes[0].images[0].get_array().shape == (20, 40)
    assert len(figure.axes) == 2  # with the bar of grey levels
    heights = np.linspace(0, 4e-4, 96).reshape(8, 12)
    relief = tc.PhaseMask(heights, 0.02, 1.5)
    figure = tc.plot.mask(relief, wavelength=5e-4, samples=12)
    phase = figure.axes[1].images[0].get_array()
    turns = 2 * np.pi * 0.5 * heights / 5e-4
    np.testing.assert_allclose(np.exp(1j * phase), np.exp(1j * turns), atol=1e-9)


def result(**changed):
    found = RankedDesign(
        "found 1",
        small.pairs([20.0, 17.0]),
        0.1,
        0.09,
        np.ones(64),
        (FreeValue("beta", (1,), 20.0, 0.1), FreeValue("beta", (2,), 17.0, None)),
    )
    old = replace(found, name="pairs", design=small.pairs())
    axis = np.linspace(12, 30, 7)
    costs = np.linspace(0.09, 0.4, 49).reshape(7, 7)
    named = (("beta", (1,)), ("beta", (2,)))
    around = Landscape(named, (axis, axis), costs, BayesError())
    whole = FoundDesigns(BayesError(), old, (found,), 1, 0, 2.5, 18.75, around)
    return replace(whole, **changed)


def test_landscape_with_the_designs():
    figure = draw_objective(result(), 1)
    labels = [line.get_label() for line in figure.axes[0].lines]
    assert labels == ["pairs (-10.46 dB)", "found 1 (-10.46 dB)"]
    assert draw_objective(result(landscape=None), 1) is None


def test_fronts():
    scores = fronts()
    figure = draw_fronts(scores, "pairs", 100.0)
    assert [ax.get_xlabel().split(":")[0] for ax in figure.axes] == [
        *("thickness", "captures", "light")
    ]
    drawn = {line.get_label(): line for line in figure.axes[0].lines}
    assert drawn["on the front"].get_markerfacecolor() == "black"
    np.testing.assert_array_equal(drawn["on the front"].get_xydata(), [[2, 10], [2.5, 12]])
    hollow = drawn["dominated by one of lower cost"]
    assert hollow.get_markerfacecolor() == "white"
    np.testing.assert_array_equal(hollow.get_xydata(), [[3, 12]])
    np.testing.assert_array_equal(drawn["pairs"].get_xydata(), [[3, 11]])
    assert figure.axes[2].get_xscale() == "log"
    alone = draw_fronts(replace(scores, thickness=None, captures=None), "pairs", 100.0)
    assert len(alone.axes) == 1


RNG = np.random.default_rng(0)
CAMERA = tc.LenslessCamera(
    tc.FresnelZoneAperture(12.0, width=1.6), tc.Sensor((24, 32), 100 * um), distance=4.0
)


def titles(figure):
    return [axes.get_title() for axes in figure.axes]


def test_a_recording_shows_captures_and_the_psf():
    scene = tc.Scene(tc.ImagePlane(RNG.random((8, 12)), 250.0, 60.0), 550 * nm)
    assert titles(draw_recording(tc.record(CAMERA, scene))) == ["capture", "PSF"]
    operator = Separable(RNG.random((24, 9)), RNG.random((32, 12)))
    others = (
        tc.Recording(RNG.random((5, 24, 32)), tc.Psfs(RNG.random((5, 9, 9)))),
        tc.Recording([RNG.random((3, 24, 32))], operator),
        tc.Recording([RNG.random((24, 32))], tc.Cameras([CAMERA])),  # for fringe scanning
    )
    shown = [titles(draw_recording(one)) for one in others]
    assert shown == [[*(f"capture {n} of 5" for n in (1, 2, 3)), "PSF"], ["capture"], ["capture"]]


def test_all_of_them_show_themselves():
    scene = tc.Scene(tc.ImagePlane(RNG.random((8, 12)), 250.0, 60.0), 550 * nm)
    for one in (scene, CAMERA, tc.record(CAMERA, scene)):
        assert one._repr_png_()[:4] == b"\x89PNG"


def test_methods_of_the_same_captures_and_sums_share_a_transfer_function():
    study = tiny.study()
    first = study.methods[0]
    twin = dataclasses.replace(first, name="twin")
    other = dataclasses.replace(study, methods=(*study.methods, twin))
    responses = {
        m.name: Response(np.arange(3.0), np.full(3, float(n)), ResponseLimits(None, None, 1.0, 1.0))
        for n, m in enumerate(other.methods)
    }
    panels = _by_synthesis(other, responses)
    assert [title for title, _ in panels] == [f"{first.name}; twin", study.methods[1].name]
    assert panels[0][1] is responses[first.name]
    # The same captures, but other sums of them.
    odd = dataclasses.replace(
        twin, name="1", synthesis="harmonics", harmonics=(1,), solver=tc.Wiener()
    )
    even = dataclasses.replace(twin, name="2", synthesis="separate", solver=tc.Wiener())
    both = dataclasses.replace(study, methods=(odd, even))
    either = {method.name: responses["twin"] for method in both.methods}
    assert len(_by_synthesis(both, either)) == 2


def test_tolerances_as_parts_of_their_numbers():
    values = (FreeValue("beta", (1,), 20.0, 0.5), FreeValue("width", (), 2.0, None))
    near = Derivatives(np.zeros(2), np.ones(2))
    (axes,) = tc.plot.sensitivity(Sensitivity(values, near, 0.01)).axes
    assert [bar.get_width() for bar in axes.patches] == [2.5, pytest.approx(np.nan, nan_ok=True)]
    assert [label.get_text() for label in axes.get_yticklabels()] == [
        "β of shot 1, rad/mm²\n20.00 (±0.5)",
        "mask width, mm\n2.00",
    ]


def test_a_front_tells_dominated_points_apart():
    worth = ((2.0, 10.0, 0.3), (3.0, 12.0, 0.2), (4.0, 11.0, 0.1))
    points = [FrontPoint(cost, small.pairs(), limit, "", error) for cost, limit, error in worth]
    left, right = tc.plot.front(points, "thickness (mm)").axes
    assert (left.get_xlabel(), right.get_xlabel()) == ("thickness (mm)",) * 2
    np.testing.assert_array_equal(left.lines[1].get_xydata(), [[2, 10], [3, 12]])
    np.testing.assert_array_equal(left.lines[2].get_xydata(), [[4, 11]])
    assert left.lines[2].get_markerfacecolor() == "white"
    assert len(right.lines[1].get_xydata()) == 3
