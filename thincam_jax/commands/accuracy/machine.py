"""What the times were measured on."""

import os
import platform
from typing import Any

import jax


def machine() -> dict[str, Any]:
    """Device, usable cores and version of JAX."""
    device = jax.devices()[0]
    try:
        cores = len(os.sched_getaffinity(0))
    except AttributeError:  # not on every system
        cores = os.cpu_count() or 1
    return {
        "platform": f"{platform.system()} {platform.machine()}",
        "device_kind": device.device_kind,
        "device_platform": device.platform,
        "cores": cores,
        "jax": jax.__version__,
    }
