"""LenslessPiCam, scico, chromatix, dLux and a plain NumPy ADMM behind one interface each.

A reconstruction gets a capture and a PSF of the same even shape and returns the image in front of
the sensor; all model the crop of the sensor on a window of twice its size. Settings are the weight
of the prior, a common factor of the penalties, and a factor of the penalty of the prior.

A propagation gets the field behind a mask on a square grid, and returns the irradiance farther on.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import scipy.fft
from scipy_admm import ScipyAdmm

PENALTIES = 1e-6, 1e-5, 4e-5  # data, variation, image: LenslessPiCam's defaults


def thincam(solver, **settings):
    """`tc.reconstruct` from the capture and the PSF alone; the iterations are its own."""
    import thincam_jax as tc

    def reconstruct(capture, psf):
        with jax.enable_x64(False):
            recording = tc.Recording(capture[None], tc.Psfs(psf[None]))
            image = tc.reconstruct(recording, getattr(tc, solver)(**settings)).image
        return np.asarray(image).reshape(capture.shape)

    return reconstruct


def normalised(capture, psf):
    """LenslessPiCam's units: PSFs of norm 1, captures of at most 1."""
    return capture / capture.max(), psf / np.linalg.norm(psf)


def penalties(common, prior):
    data, variation, image = (common * value for value in PENALTIES)
    return data, prior * variation, image


def window_of(capture):
    """Shape of the window, and the corner of the sensor in it."""
    window = tuple(scipy.fft.next_fast_len(2 * n - 1, real=True) for n in capture.shape)
    return window, tuple((w - n) // 2 for w, n in zip(window, capture.shape, strict=True))


def in_front(image, capture, corner):
    return image[tuple(slice(c, c + n) for c, n in zip(corner, capture.shape, strict=True))]


def lensless_picam(capture, psf, settings, iterations):
    from lensless.recon.admm import ADMM

    capture, psf = (part[None, ..., None].astype(np.float32) for part in normalised(capture, psf))
    weight, *factors = settings
    data, variation, image = penalties(*factors)
    solver = ADMM(psf, mu1=data, mu2=variation, mu3=image, tau=weight)
    solver.set_data(capture)
    found = solver.apply(n_iter=iterations, disp_iter=None, plot=False)
    return np.asarray(found).reshape(capture.shape[1:3])


def numpy_admm(capture, psf, settings, iterations):
    capture, psf = normalised(capture, psf)
    window, corner = window_of(capture)
    padded = np.pad(psf, [(0, w - n) for w, n in zip(window, psf.shape, strict=True)])
    padded = np.roll(padded, [-(n // 2) for n in psf.shape], (0, 1))
    spectrum = scipy.fft.rfft2(padded)
    solver = ScipyAdmm(spectrum, capture[None], window, corner, (0, 0), window)
    weight, *factors = settings
    solver.set(penalties(*factors), weight)
    return in_front(solver.run(iterations)[0], capture, corner)


def _scico(capture, psf, priors, iterations):
    """Image by scico's ADMM; `priors(window)`: functionals, operators and penalties.

    Data, prior and sign are split as in scico's example of deconvolution microscopy.
    """
    import scico.numpy as snp
    from scico import functional, linop, loss
    from scico.optimize.admm import ADMM, CircularConvolveSolver

    window, corner = window_of(capture)
    margins = [(c, w - n - c) for c, w, n in zip(corner, window, capture.shape, strict=True)]

    def padded(part):
        return snp.array(np.pad(part, margins).astype(np.float32))

    centre = snp.array([n // 2 for n in psf.shape])
    kernel = snp.array(psf.astype(np.float32))
    mask = linop.Diagonal(padded(np.ones_like(capture)))
    functionals, operators, rho = priors(window)
    solver = ADMM(
        f=None,
        g_list=[
            loss.SquaredL2Loss(y=padded(capture), A=mask),
            *functionals,
            functional.NonNegativeIndicator(),
        ],
        C_list=[
            linop.CircularConvolve(h=kernel, input_shape=window, h_center=centre),
            *operators,
            linop.Identity(window),
        ],
        rho_list=list(rho),
        maxiter=iterations,
        x0=snp.zeros(window, dtype=np.float32),
        subproblem_solver=CircularConvolveSolver(),
        itstat_options={"display": False, "period": iterations},
    )
    return np.maximum(in_front(np.asarray(solver.solve()), capture, corner), 0)


def scico(capture, psf, settings, iterations):
    from scico import functional, linop

    weight, *factors = settings

    def variation(window):
        operator = linop.FiniteDifference(input_shape=window, circular=True)
        return [weight * functional.L21Norm()], [operator], penalties(*factors)

    return _scico(*normalised(capture, psf), variation, iterations)


def scico_dncnn(capture, psf, settings, iterations):
    """Plug and play with scico's own DnCNN; PSFs of sum 1, for which images are from 0 to 1."""
    from scico import functional, linop

    data, image = settings

    def denoiser(window):
        return [functional.DnCNN("6L")], [linop.Identity(window)], (data, image, image)

    return _scico(capture, psf, denoiser, iterations)


def chromatix_fresnel(field, pitch, distance, wavelength):
    """The convolution by Fresnel's transfer function, on a window of twice the size."""
    return _chromatix("transfer_propagate", field, pitch, distance, wavelength)


def chromatix_angular_spectrum(field, pitch, distance, wavelength):
    return _chromatix("asm_propagate", field, pitch, distance, wavelength, bandlimit=True)


def _chromatix(model, field, pitch, distance, wavelength, **options):
    import chromatix.functional as cf

    pad = field.shape[0] // 2

    def irradiance(values):
        wave = cf.plane_wave(values.shape, pitch, wavelength, power=None) * values
        propagate = getattr(cf, model)
        found = propagate(wave, distance, 1.0, pad_width=pad, mode="same", **options)
        return found.intensity.reshape(values.shape)

    return _compiled(irradiance, field)


def dlux_angular_spectrum(field, pitch, distance, wavelength):
    """The angular spectrum of dLux's backend abcdLux, which is paraxial; metres."""
    import dLux

    propagate = dLux.ASMPropagator(distance=distance * 1e-3, spec=dLux.PadSpec(pad=2, crop=2))

    def irradiance(values):
        wave = dLux.Wavefront.from_phasor(values, wavelength * 1e-3, pixel_scale=pitch * 1e-3)
        return propagate(wave).psf

    return _compiled(irradiance, field)


def _compiled(irradiance, field):
    """A call without arguments, of one compiled program."""
    compiled, values = jax.jit(irradiance), jnp.asarray(field)
    return partial(lambda: jax.block_until_ready(compiled(values)))
