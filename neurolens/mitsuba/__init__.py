"""neurolens cameras in Mitsuba 3: its scenes, unmodified, through an exported lens (extra "mitsuba").

    import mitsuba as mi
    import neurolens.mitsuba as nm

    mi.set_variant("llvm_ad_spectral")
    camera = nm.camera("models/laikin_double_gauss_50.ols-64.onnx", focus_m=3.9, f_number=2.0)
    picture = nm.render(mi.cornell_box(), camera, spp=64)

or, in a scene (`<sensor type="neurolens">` in XML), after `nm.register()`:

    {"type": "neurolens", "camera": "models/NAME.onnx", "focus_m": 3.9, "f_number": 2.0, "to_world": ..., "film": ...}

Mitsuba itself is imported by the functions, not with this package.
"""

from neurolens.mitsuba.library import require_mitsuba
from neurolens.mitsuba.scenes import camera, load_scene, render
from neurolens.mitsuba.sensor import register

__all__ = ["camera", "load_scene", "register", "render", "require_mitsuba"]
