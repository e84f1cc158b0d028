"""The explorer as a widget of notebooks: `tc.explore(camera)`."""

import dataclasses
from pathlib import Path
from typing import Any

from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Number
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.plot.explorer import Explorer
from thincam_jax.units import nm

MODULE = Path(__file__).with_name("explorer.js")


@checked
def explore(
    camera: LenslessCamera,
    scene: Any = None,
    *,
    wavelength: Number = 550 * nm,
    object_distance: Number = 250.0,
) -> Any:
    """Turn the numbers of a camera and see its PSF, transfer function, capture and image.

    A widget for Jupyter, VS Code, Colab and marimo. `widget.camera` is the camera as it is set,
    `widget.light` the wavelength and the distance of the object. Arguments as of `Explorer`; on a
    page of its own, without a notebook, it is `thincam explore`.

    **Errors**: ImportError without the extra `notebook`.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import um

    mask = tc.FresnelZoneAperture(25.0, width=1.6)
    camera = tc.LenslessCamera(mask, tc.Sensor((96, 128), 15 * um), distance=5.0)
    widget = tc.explore(camera)
    print(widget.camera.distance)  # 5.0
    ```

    **See also**: `plot.psf`, `plot.otf`.
    """
    try:
        import anywidget
        import traitlets
    except ImportError:
        raise ImportError(
            "tc.explore needs anywidget; pip install 'thincam_jax[notebook]'"
        ) from None
    explorer = Explorer(camera, scene, wavelength=wavelength, object_distance=object_distance)

    class Widget(anywidget.AnyWidget):
        _esm = MODULE
        controls = traitlets.List().tag(sync=True)
        camera = property(lambda self: explorer.camera)
        light = property(lambda self: explorer.light)

    def answer(widget: Any, message: Any, buffers: Any) -> None:
        explorer.turn(message["values"])
        header, pictures = explorer.view(rest=message["rest"]).message()
        widget.send({"id": message["id"], "header": header}, pictures)

    widget = Widget(controls=[dataclasses.asdict(control) for control in explorer.controls])
    widget.on_msg(answer)
    return widget
