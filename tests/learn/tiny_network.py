"""The smallest camera and network that refocus: 16×18 pixels of 44 µm, images of 14×12.

With the PSF that is compiled fastest: what is tested by them does not depend on it.
"""

import functools

import jax

import thincam_jax as tc
from thincam_jax.learn.refocusing.cameras import RefocusCamera
from thincam_jax.learn.refocusing.network import NetworkOptions, RefocusNetwork
from thincam_jax.learn.refocusing.sources import drawn
from thincam_jax.learn.refocusing.train import Lessons
from thincam_jax.learn.training import TrainingOptions
from thincam_jax.units import nm, um

TRAINING = TrainingOptions(steps=4, rate=3e-3, warm_up=1, check_every=2)


def camera(beta=13.0, **more):
    aperture = tc.FresnelZoneAperture(beta, width=0.7)
    return tc.LenslessCamera(aperture, tc.Sensor((16, 18), 44 * um, **more), 7.5)


@functools.cache
def network():
    """Untrained."""
    whole = RefocusCamera(
        camera(), 500 * nm, field_shape=(14, 12), near=50.0, far=200.0, planes=2, model="geometric"
    )
    options = NetworkOptions(steps=1, widths=(4, 4))
    return RefocusNetwork.create(whole, options, key=jax.random.key(1))


@functools.cache
def lessons():
    return Lessons(drawn(0, 4, 24), batch=2, pool=2, judged=1)
