"""Small deconvolutions as dense matrices, and a slow solver that shares no line with ADMM."""

import itertools

import numpy as np


def matrix(kernel, sensor, field, pitch=1.0):
    """The crop-convolution (pixel, sample) by its sum; kernel on all differences r − r′."""
    result = np.empty((*sensor, *field))
    for y, x, m, n in itertools.product(*(range(k) for k in (*sensor, *field))):
        result[y, x, m, n] = kernel[y - m + field[0] - 1, x - n + field[1] - 1]
    return pitch**2 * result.reshape(sensor[0] * sensor[1], -1)


def slopes(shape, depth_weight=0.0):
    """Forward differences of an image (plane, y, x): three matrices, zero rows at the ends."""
    index = np.arange(np.prod(shape)).reshape(shape)
    result = []
    for axis, weight in ((1, 1.0), (2, 1.0), (0, depth_weight)):
        difference = np.zeros((index.size, index.size))
        first, second = np.delete(index, -1, axis).ravel(), np.delete(index, 0, axis).ravel()
        difference[first, first], difference[first, second] = -weight, weight
        result.append(difference)
    return np.stack(result)  # (direction, sample, sample)


def lengths(table, kind, joint):
    """Lengths of slopes (direction, channel, sample), joined as the variation says."""
    if kind == "isotropic":
        return np.sqrt((table**2).sum(axis=(0, 1) if joint else 0, keepdims=True))
    return np.sqrt((table**2).sum(axis=1, keepdims=True)) if joint else np.abs(table)


def objective(image, parts, tau, psi, kind, joint):
    """E of an image (channel, sample); parts: matrices (channel, pixel, sample), data, weights."""
    misfit = sum(
        0.5 * (w * (np.einsum("cps,cs->cp", a, image) - g) ** 2).sum() for a, g, w in parts
    )
    return misfit + tau * lengths(np.einsum("dts,cs->dct", psi, image), kind, joint).sum()


def primal_dual(parts, tau, psi, kind, joint, *, nonnegative=True, iterations=20_000, balance=1.0):
    """Condat and Vũ's primal-dual method (J. Optim. Theory Appl. 158, 460, 2013), step by step.

    A gradient step on the misfit, a projection on f ≥ 0, and a projection of the dual slopes on the
    ball of radius τ: no inverse, no Fourier transform.
    """
    channels, size = parts[0][0].shape[0], parts[0][0].shape[-1]
    hessian = sum(
        np.einsum("cps,cp,cpt->cst", a, np.broadcast_to(w, g.shape), a) for a, g, w in parts
    )
    pulled = sum(np.einsum("cps,cp->cs", a, w * g) for a, g, w in parts)
    steep = max(np.linalg.norm(h, 2) for h in hessian)
    stacked = psi.reshape(-1, size)
    bend = np.linalg.norm(stacked, 2)
    dual_step = balance * steep / bend**2
    step = 0.99 / (steep / 2 + dual_step * bend**2)
    image, dual = np.zeros((channels, size)), np.zeros((psi.shape[0], channels, size))
    transposed = np.ascontiguousarray(stacked.T)
    for _ in range(iterations):
        gradient = np.einsum("cst,ct->cs", hessian, image) - pulled
        back = dual.transpose(1, 0, 2).reshape(channels, -1) @ transposed.T
        new = image - step * (gradient + back)
        new = np.maximum(new, 0) if nonnegative else new
        ahead = (2 * new - image) @ transposed
        dual = dual + dual_step * ahead.reshape(channels, -1, size).transpose(1, 0, 2)
        dual = dual / np.maximum(1, lengths(dual, kind, joint) / tau)
        image = new
    return image
