"""Recordings as linear models of other packages: transposes, gradients, and their solvers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse.linalg

import thincam_jax as tc
from helpers import relative_l2
from thincam_jax.imaging.operators import Matrix
from thincam_jax.reconstruction.exchange import (
    LinearModel,
    deepinv_physics,
    scico_operator,
    scipy_operator,
)
from thincam_jax.reconstruction.problem import forward, gradient
from thincam_jax.units import nm, um


@pytest.fixture(scope="module", params=["known", "found"])
def recording(request):
    """Two phases in two colours, with dead pixels and other noise in each capture."""
    random = np.random.default_rng(0)
    masks = [tc.FresnelZoneAperture(25.0, phase, width=1.6) for phase in (0.0, np.pi)]
    sensor = tc.Sensor((24, 30), 60 * um)
    cameras = [tc.LenslessCamera(mask, sensor, distance=5.0) for mask in masks]
    optics = tc.Cameras(cameras, wavelength=500 * nm, object_distance=250.0, field_shape=(14, 18))
    dark = tc.Recording(np.zeros((2, 2, 24, 30)), optics, noise_variance=1.0)
    scene = jnp.asarray(np.kron(random.uniform(size=(2, 1, 2, 3)), np.ones((7, 6))))
    clean = np.stack([forward(one, scene) for one in dark.problem().operators])
    return tc.Recording(
        clean + 0.01 * random.normal(size=clean.shape),
        optics,
        noise_variance=[1e-4, 4e-4],
        valid=random.uniform(size=(24, 30)) > 0.1,
        background=0.0 if request.param == "known" else None,
    )


def test_model_is_that_of_the_solvers(recording):
    """Its least squares have the gradient of the recording's problem, over the mean weight."""
    model, random = LinearModel.of(recording), np.random.default_rng(1)
    image = jnp.asarray(random.uniform(size=model.image_shape))
    capture = jnp.asarray(random.normal(size=model.measurements.shape))
    across = jnp.vdot(model.apply(image), capture), jnp.vdot(image, model.adjoint(capture))
    assert float(across[0]) == pytest.approx(float(across[1]), rel=1e-9)
    found = model.adjoint(model.apply(image) - model.measurements)
    problem = recording.problem(nonnegative=False)
    turned = gradient(problem, image[..., ::-1, ::-1]) * model.noise_std**2
    assert relative_l2(found, turned[..., ::-1, ::-1]) < 1e-9
    assert model.noise_std == pytest.approx((np.mean([1e4, 2500]) ** -0.5), rel=0.01)


def test_solvers_of_scipy_find_the_minimum(recording):
    operator, measured, noise_std = scipy_operator(recording)
    found = scipy.sparse.linalg.lsqr(operator, measured, damp=30 * noise_std, iter_lim=400)[0]
    slope = operator.rmatvec(operator.matvec(found) - measured) + (30 * noise_std) ** 2 * found
    assert np.linalg.norm(slope) < 1e-4 * np.linalg.norm(operator.rmatvec(measured))
    pylops = pytest.importorskip("pylops")
    assert pylops.utils.dottest(pylops.aslinearoperator(operator), rtol=1e-9)


def test_captures_of_several_shapes_are_refused():
    operators = [Matrix(np.ones((n, 6)), (2, 3), (n, 1)) for n in (4, 5)]
    captures = [np.ones((n, 1)) for n in (4, 5)]
    with pytest.raises(ValueError, match="give captures of one shape"):
        LinearModel.of(tc.Recording(captures, operators, noise_variance=1.0))


def test_scico_takes_it(recording):
    """Its ADMM with its total variation ends where the objective is stationary."""
    pytest.importorskip("scico")
    from scico import functional, linop, loss, optimize

    operator, measured, _ = scico_operator(recording)
    with jax.numpy_dtype_promotion("standard"):
        difference = linop.FiniteDifference(
            operator.input_shape, measured.dtype, axes=(-2, -1), append=0
        )
        solver = optimize.ADMM(
            f=loss.SquaredL2Loss(y=measured, A=operator),
            g_list=[1e-3 * functional.L21Norm()],
            C_list=[difference],
            rho_list=[1e-2],
            x0=operator.T(measured),
            maxiter=30,
        )
        image = solver.solve()
        errors = [jnp.linalg.norm(operator(one) - measured) for one in (0 * image, image)]
    assert float(errors[1]) < 0.7 * float(errors[0])


def test_deepinv_takes_it(recording):
    """Gradients go through both ways, and its proximal gradients with its prior make an image."""
    deepinv, torch = pytest.importorskip("deepinv"), pytest.importorskip("torch")
    physics, measured = deepinv_physics(recording)
    model = LinearModel.of(recording)
    assert measured.shape == (1, 4, 24, 30)
    image = torch.rand(2, 2, 14, 18, dtype=measured.dtype, requires_grad=True)
    one = image[:1].detach()
    assert float(physics.adjointness_test(one).abs()) < 1e-6
    physics.A(image).square().sum().backward()
    expected = [
        jax.grad(lambda x: jnp.sum(model.apply(x) ** 2))(jnp.asarray(each)[:, None])
        for each in image.detach().numpy()
    ]
    assert relative_l2(image.grad.numpy(), np.asarray(expected)[:, :, 0]) < 1e-6
    stepsize = 1 / float(physics.compute_sqnorm(one))
    solver = deepinv.optim.PGD(
        prior=deepinv.optim.prior.TVPrior(n_it_max=20),
        data_fidelity=deepinv.optim.data_fidelity.L2(),
        stepsize=stepsize,
        lambda_reg=1e-3,
        max_iter=30,
    )
    left = (physics.A(solver(measured, physics)) - measured).norm() / measured.norm()
    assert float(left) < 0.7
