"""Whether JAX can start with the variables of the environment."""

import os


def cannot_start() -> str:
    """The fault of variables with which JAX cannot start, in a line; empty where it can."""
    for name in ("", "_HOST_TO_DEVICE", "_DEVICE_TO_HOST", "_DEVICE_TO_DEVICE"):
        if (given := os.environ.get(f"JAX_TRANSFER_GUARD{name}", "")).startswith("disallow"):
            return (
                f"JAX_TRANSFER_GUARD{name}={given} forbids to read a file into an array; unset it"
            )
    names = ("JAX_PLATFORMS", "JAX_ENABLE_X64")
    settings = " ".join(f"{name}={os.environ[name]}" for name in names if name in os.environ)
    if not settings:
        return ""
    try:
        import jax

        jax.devices()
    except (AssertionError, RuntimeError, ValueError) as error:
        reason = (str(error).splitlines() or ["there is no such device"])[0]
        return f"JAX cannot start with {settings} ({reason}); unset it"
    return ""
