"""ADMM-TV with the crop of the sensor in NumPy and scipy.fft, as carefully as we know how.

The same problem and the same iteration as `thincam_jax.reconstruction.splittings`, in single
precision: what can be computed once is, arrays are reused, transforms are real and run on all
cores.
"""

import os

import numpy as np
import scipy.fft

WORKERS = os.cpu_count()


class ScipyAdmm:
    """Captures (channel, y, x) of a field by one PSF, given as a spectrum on the window.

    `penalties` (data, variation, image) and `tau` are absolute; `relaxation` is α.
    """

    def __init__(self, spectrum, capture, window, sensor_corner, field_corner, field_shape):
        self.spectrum = spectrum.astype(np.complex64)
        self.conjugate = self.spectrum.conj()
        self.capture = capture.astype(np.float32)
        self.window = window
        rows, columns = capture.shape[-2:]
        (y, x), (v, u) = sensor_corner, field_corner
        self.sensor = np.s_[:, y : y + rows, x : x + columns]
        self.field = np.s_[:, v : v + field_shape[0], u : u + field_shape[1]]
        self.field_shape = field_shape
        down, right = (
            (4 * np.sin(np.pi * f) ** 2).astype(np.float32)
            for f in (np.fft.fftfreq(window[0]), np.fft.rfftfreq(window[1]))
        )
        self.differences = down[:, None] + right
        shape = (capture.shape[0], *window)
        self.state = [np.zeros(shape, np.float32) for _ in range(4)]  # data, down, right, image
        self.work = [np.empty(shape, np.float32) for _ in range(6)]

    def set(self, penalties, tau, relaxation=1.0):
        self.penalties, self.tau = [np.float32(p) for p in penalties], np.float32(tau)
        self.relaxation = np.float32(relaxation)
        data, variation, image = self.penalties
        power = np.abs(self.spectrum) ** 2
        self.inverse = 1 / (data * power + variation * self.differences + image)
        self.back = data * self.conjugate * self.inverse

    def run(self, iterations: int):
        for _ in range(iterations):
            self.step()
        return self.image()

    def step(self):
        """q ← q + α (K f − z), with f what fits 2z − q best."""
        data, down, right, image = self.state
        z_data, z_down, z_right, z_image, length, total = self.work
        mu_data, mu_variation, mu_image = self.penalties
        np.copyto(z_data, data)
        seen = z_data[self.sensor]
        seen *= mu_data
        seen += self.capture
        seen /= 1 + mu_data
        self._shrink(down, right, z_down, z_right, length)
        z_image.fill(0)
        np.maximum(image[self.field], 0, out=z_image[self.field])
        # The sum of differences of 2z − q, weighed; `length` holds one of them at a time.
        np.multiply(z_image, 2, out=total)
        total -= image
        total *= mu_image / mu_variation
        self._subtract_divergence(down, z_down, length, total, axis=-2)
        self._subtract_divergence(right, z_right, length, total, axis=-1)
        total *= mu_variation
        spectrum = scipy.fft.rfft2(total, workers=WORKERS, overwrite_x=True)
        spectrum *= self.inverse
        np.multiply(z_data, 2, out=length)
        length -= data
        other = scipy.fft.rfft2(length, workers=WORKERS, overwrite_x=True)
        other *= self.back
        spectrum += other
        np.multiply(spectrum, self.spectrum, out=other)
        fitted = scipy.fft.irfft2(spectrum, s=self.window, workers=WORKERS, overwrite_x=True)
        projected = scipy.fft.irfft2(other, s=self.window, workers=WORKERS, overwrite_x=True)
        self._update(data, z_data, projected)
        self._difference(fitted, length, axis=-2)
        self._update(down, z_down, length)
        self._difference(fitted, length, axis=-1)
        self._update(right, z_right, length)
        self._update(image, z_image, fitted)

    def _update(self, q, z, k):
        k -= z
        if self.relaxation != 1:
            k *= self.relaxation
        q += k

    def _shrink(self, down, right, z_down, z_right, length):
        """Proximal map of the variation inside of the field; beside it nothing changes."""
        np.copyto(z_down, down)
        np.copyto(z_right, right)
        inside_down, inside_right = z_down[self.field], z_right[self.field]
        size = length[self.field]
        edge_down, edge_right = inside_down[:, -1].copy(), inside_right[:, :, -1].copy()
        inside_down[:, -1] = 0
        inside_right[:, :, -1] = 0
        np.multiply(inside_down, inside_down, out=size)
        size += inside_right * inside_right
        np.sqrt(size, out=size)
        np.maximum(size, np.float32(1e-30), out=size)
        np.divide(-self.tau / self.penalties[1], size, out=size)
        size += 1
        np.maximum(size, 0, out=size)
        inside_down *= size
        inside_right *= size
        inside_down[:, -1] = edge_down
        inside_right[:, :, -1] = edge_right

    @staticmethod
    def _difference(image, out, axis):
        if axis == -2:
            np.subtract(image[:, 1:], image[:, :-1], out=out[:, :-1])
            np.subtract(image[:, :1], image[:, -1:], out=out[:, -1:])
        else:
            np.subtract(image[:, :, 1:], image[:, :, :-1], out=out[:, :, :-1])
            np.subtract(image[:, :, :1], image[:, :, -1:], out=out[:, :, -1:])

    @staticmethod
    def _subtract_divergence(q, z, work, total, axis):
        """total += Ψᵀ(2z − q) along an axis."""
        np.multiply(z, 2, out=work)
        work -= q
        total -= work
        if axis == -2:
            total[:, 1:] += work[:, :-1]
            total[:, :1] += work[:, -1:]
        else:
            total[:, :, 1:] += work[:, :, :-1]
            total[:, :, :1] += work[:, :, -1:]

    def image(self):
        return np.maximum(self.state[3][self.field], 0)
