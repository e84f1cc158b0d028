"""The camera of ERRATA's defaults: what the thesis gives, and what it leaves open."""

import thincam_jax as tc
from thincam_jax import waveguide as wg
from thincam_jax.units import deg, nm, um

RECORDED = 532 * nm


def hologram(index=1.5, **changes):
    values = {"index": index, "thickness": 16 * um, "index_modulation": 0.02} | changes
    return wg.VolumeHologram.record(RECORDED, 0.0, 61.2 * deg, **values)


def camera(film=None, glass=1.5, shape=(440, 440), **places):
    film = hologram() if film is None else film
    sensor = tc.Sensor(shape, 4.8 * um)
    return wg.SeeThroughCamera(wg.Screen(film, 5.0, glass, **places), sensor, 6.0, 10.0)
