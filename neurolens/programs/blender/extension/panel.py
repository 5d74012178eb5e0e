"""Menu, operators and panel: at the camera's data properties, "Lens (neurolens)"."""

from __future__ import annotations

import sys
import textwrap
from pathlib import Path
from typing import Any

import bpy
import bpy.utils.previews

from . import camera as on_camera, library as facts
from .library import LensError, LensFacts

_FIRST = ("f_number", "focus_m", "zoom_mm")  # settings that come before the others
_LABELS = {  # where Blender would show the bare name
    "f_number": "F-Number",
    "focus_m": "Focus (m)",
    "zoom_mm": "Zoom (mm)",
    "tilt": "Film Tilt (degrees)",
    "swing": "Film Swing (degrees)",
    "exposure": "Exposure: 0 Blender, 1 Lens",
    "origin": "Origin: 0 Film, 1 Pupil",
    "unit_m": "Metres per Unit",
}


class Library:
    """The lenses and their thumbnails, which are read once, and again by `load`."""

    def __init__(self) -> None:
        self.lenses: dict[str, LensFacts] = {}
        self.wrong: list[str] = []
        # kept, because Blender does not hold the texts of menus
        self.items: dict[str, list[tuple[str, str, str, int, int]]] = {}
        self.found: list[tuple[str, str, str, int, int]] = []  # with the words that its search finds
        self.bokeh: dict[str, int] = {}
        self.pictures: Any = None

    def load(self) -> None:
        """Read the extension's folder and the user's."""
        self.close()
        folders = [Path(__file__).parent]
        try:
            folders.append(Path(bpy.utils.extension_path_user(__package__, create=False)))
        except ValueError:
            pass  # this does not run as an extension
        self.lenses, self.wrong = facts.read_library(folders)
        self.pictures = bpy.utils.previews.new()
        icons = {name: self._icon(name, lens.picture) for name, lens in self.lenses.items()}
        self.bokeh = {name: self._icon(f"bokeh of {name}", lens.bokeh) for name, lens in self.lenses.items()}

        self.items = {}
        for order in facts.ORDERS:
            # A menu shows the section of a lens, or its bokeh where lenses are sorted by their character.
            shown = icons | {k: v for k, v in self.bokeh.items() if v and order in facts.CHARACTER}
            self.items[order] = [
                (lens.lens_id, lens.entry(order), lens.source, shown[lens.lens_id], lens.number)
                for lens in facts.ordered(self.lenses.values(), order)
            ]

        self.found = [
            (lens.lens_id, " ".join((lens.entry("maker"), lens.said)), lens.source, icons[name], lens.number)
            for name, lens in self.lenses.items()
        ]

    def _icon(self, name: str, picture: Path | None) -> int:
        """Return the number of a picture, which Blender reads when it is first shown; 0 without one."""
        shown = picture is not None and picture.is_file()
        return self.pictures.load(name, str(picture), "IMAGE").icon_id if shown else 0

    def close(self) -> None:
        """Release the thumbnails."""
        if self.pictures is not None:
            bpy.utils.previews.remove(self.pictures)
            self.pictures = None


LIBRARY = Library()


def _lens_items(props: Any, _context: Any) -> list[tuple[str, str, str, int, int]]:
    return LIBRARY.items.get(props.order) or [("NONE", "no lenses", "the extension holds none", 0, 0)]


def _changed(props: Any, context: Any) -> None:
    """Put a lens on at once when it is chosen in the menu of a camera that carries one."""
    props.message = props.advice = ""
    camera = props.id_data
    if not on_camera.applied(camera) or props.busy:
        return
    found = next((o for o in context.scene.objects if o.data == camera), None)
    if found is None:
        return
    try:
        lens = lens_of(props)
        on_camera.apply(context.scene, found, lens, kind_of(props, lens))
    except LensError as error:
        props.message = str(error)


class CameraSettings(bpy.types.PropertyGroup):
    """The lens settings of a camera, and Blender's own from before."""

    __annotations__ = {
        "lens": bpy.props.EnumProperty(name="Lens", items=_lens_items, update=_changed),
        "order": bpy.props.EnumProperty(
            name="Sort By",
            description="Order of the menu of lenses; of a character the strongest come first",
            items=[(key, text, "", number) for number, (key, text) in enumerate(facts.ORDERS.items())],
        ),
        "kind": bpy.props.EnumProperty(
            name="Form",
            items=[
                ("polynomial", "Polynomial", "A polynomial fitted to the lens", 0),
                ("network", "Network", "A small neural network fitted to the lens", 1),
                ("exact", "Exact", "Every surface traced: slow, without error", 2),
            ],
            update=_changed,
        ),
        "message": bpy.props.StringProperty(options={"HIDDEN", "SKIP_SAVE"}),
        "before": bpy.props.StringProperty(options={"HIDDEN"}),
        "on": bpy.props.StringProperty(options={"HIDDEN"}),
        "tolerance_px": bpy.props.FloatProperty(
            name="Tolerance",
            description="Error of place and blur that is allowed, in pixels of this render",
            default=0.25,
            min=0.001,
            soft_max=5.0,
        ),
        "advice": bpy.props.StringProperty(options={"HIDDEN", "SKIP_SAVE"}),
        "busy": bpy.props.BoolProperty(options={"HIDDEN", "SKIP_SAVE"}),
    }


def lens_of(props: Any) -> LensFacts:
    """Return the lens that is chosen.

    Raises:
        LensError: the library does not have the lens.
    """
    if props.lens not in LIBRARY.lenses:
        raise LensError("The chosen lens is not in the library: choose another")
    return LIBRARY.lenses[props.lens]


def kind_of(props: Any, lens: LensFacts) -> str:
    """Return the form that is chosen, or the first that the lens has."""
    return props.kind if props.kind in lens.variants else next(iter(lens.variants), "")


class _Operator(bpy.types.Operator):
    """Base of operators: an error is one line, in the panel and as the operator's report."""

    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: Any) -> set[str]:
        props = None
        try:
            found = on_camera.camera_of(context)
            props = found.data.neurolens
            props.message = ""
            self.act(context, found, props)
        except LensError as error:
            if props is not None:
                props.message = str(error)
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return {"FINISHED"}

    def act(self, context: Any, found: Any, props: Any) -> None:
        raise NotImplementedError


class NEUROLENS_OT_apply(_Operator):
    """Put the chosen lens on this camera: as a custom camera of Cycles, in Open Shading Language"""

    bl_idname = "neurolens.apply"
    bl_label = "Put the Lens On"
    __annotations__ = {
        "lens": bpy.props.StringProperty(name="Lens", description="Its id; empty: the one chosen in the panel"),
        "kind": bpy.props.StringProperty(name="Form", description=f"{', '.join(facts.KINDS)}; empty: the panel's"),
        "fit_sensor": bpy.props.BoolProperty(name="Fit Sensor", description="Make the sensor as large as the picture"),
    }

    def act(self, context: Any, found: Any, props: Any) -> None:
        lens_id = self.lens or props.lens
        if lens_id not in LIBRARY.lenses:
            known = ", ".join(LIBRARY.lenses) or "none: the extension was packed without"
            raise LensError(f"There is no lens {lens_id!r}; lenses: {known}")
        lens = LIBRARY.lenses[lens_id]
        chosen = self.kind or kind_of(props, lens)
        on_camera.apply(context.scene, found, lens, chosen, fit_sensor=self.fit_sensor)
        props.busy = True
        props.lens, props.kind = lens_id, chosen
        props.busy = False


class NEUROLENS_OT_find(_Operator):
    """Find a lens by words of its name, its maker, its focal length or a nickname"""

    bl_idname = "neurolens.find"
    bl_label = "Find a Lens"
    bl_property = "lens"  # that Blender's search fills in
    __annotations__ = {"lens": bpy.props.EnumProperty(name="Lens", items=lambda _props, _context: LIBRARY.found)}

    def invoke(self, context: Any, _event: Any) -> set[str]:
        context.window_manager.invoke_search_popup(self)
        return {"FINISHED"}

    def act(self, context: Any, found: Any, props: Any) -> None:
        props.lens = self.lens


class NEUROLENS_OT_take_back(_Operator):
    """Take the lens off this camera: everything that it changed is as it was"""

    bl_idname = "neurolens.take_back"
    bl_label = "Take the Lens Off"

    def act(self, context: Any, found: Any, props: Any) -> None:
        on_camera.take_back(context.scene, found)


class NEUROLENS_OT_needs(_Operator):
    """Look at the depths in view, and say whether this shot needs the chosen lens: or a pinhole, or Cycles' own depth
    of field, would show the same"""

    bl_idname = "neurolens.needs"
    bl_label = "What Does This Shot Need?"

    def act(self, context: Any, found: Any, props: Any) -> None:
        lens, setting = lens_of(props), on_camera.setting_of(context.scene, found)
        opened = setting.f_number or (found.data.dof.aperture_fstop if found.data.dof.use_dof else lens.f_number)
        depths = on_camera.depths_in_view(context, found, setting, lens.efl_mm)
        told = facts.needs(lens, setting, depths, opened, props.tolerance_px)
        props.advice = "\n".join(told.why)
        self.report({"INFO"}, told.why[0])


class NEUROLENS_OT_reload(bpy.types.Operator):
    """Read the library again, after `neurolens blender add`"""

    bl_idname = "neurolens.reload"
    bl_label = "Read Lenses Again"

    def execute(self, context: Any) -> set[str]:
        LIBRARY.load()
        for line in LIBRARY.wrong:
            self.report({"WARNING"}, line)
        return {"FINISHED"}


class NEUROLENS_PT_lens(bpy.types.Panel):
    """The lens of a camera."""

    bl_label = "Lens (neurolens)"
    bl_space_type, bl_region_type, bl_context = "PROPERTIES", "WINDOW", "data"

    @classmethod
    def poll(cls, context: Any) -> bool:
        return getattr(context, "camera", None) is not None

    def draw(self, context: Any) -> None:
        layout, camera = self.layout, context.camera
        layout.use_property_split = True
        if (why := facts.refused(bpy.app.version, bpy.app.build_options.cycles_osl)) is not None:
            layout.label(text=why, icon="ERROR")
            return
        for line in LIBRARY.wrong:
            layout.label(text=line, icon="ERROR")
        props = camera.neurolens
        layout.prop(props, "order")
        layout.operator("neurolens.find", icon="VIEWZOOM")
        layout.template_icon_view(props, "lens", show_labels=True, scale=6.0)
        layout.prop(props, "lens", text="")
        try:
            lens = lens_of(props)
        except LensError as error:
            layout.label(text=str(error), icon="ERROR")
            return
        kind = kind_of(props, lens)
        layout.label(text=f"{lens.maker}, {lens.line}" if lens.maker else lens.line)
        if LIBRARY.bokeh.get(lens.lens_id):
            layout.template_icon(icon_value=LIBRARY.bokeh[lens.lens_id], scale=4.0)
        if lens.character:
            told = (f"{facts.CHARACTER[key].lower()} {value:.2g}" for key, value in lens.character.items())
            _wrapped(layout, ", ".join(told).capitalize(), "LIGHT")
        row = layout.row(align=True)
        row.use_property_split = False  # otherwise the first form's name stands beside its button
        for name in lens.variants:
            row.prop_enum(props, "kind", name)
        found = context.object if context.object is not None and context.object.type == "CAMERA" else None
        if found is not None and found.data == camera:
            self._draw_scene(context, found, lens, kind)
        elif props.message:
            _wrapped(layout, props.message, "ERROR")

    def _draw_scene(self, context: Any, found: Any, lens: LensFacts, kind: str) -> None:
        layout, camera = self.layout, found.data
        variant, setting = lens.variants[kind], on_camera.setting_of(context.scene, found)
        wrong, message = facts.refusals(variant, setting), camera.neurolens.message
        black = facts.outside(variant, setting)
        if message and message != "; ".join(wrong):
            _wrapped(layout, message, "ERROR")
        applied = on_camera.applied(camera)
        if not applied:
            layout.operator("neurolens.apply", icon="CAMERA_DATA")
        if facts.too_large(variant, setting):
            layout.operator("neurolens.apply", text="Fit Sensor and Put On").fit_sensor = True
        if applied:
            layout.operator("neurolens.take_back", icon="LOOP_BACK")
            self._draw_settings(camera)
        layout.operator("neurolens.reload", icon="FILE_REFRESH")
        layout.operator("neurolens.write_lights", icon="LIGHT")
        layout.prop(camera.neurolens, "tolerance_px")
        layout.operator("neurolens.needs", icon="QUESTION")
        for line in camera.neurolens.advice.splitlines():
            _wrapped(layout, line, "INFO")
        error = facts.error_px(variant, setting)
        layout.label(text="Every surface is traced" if error is None else f"Error: {error:.2g} pixels (RMS)")
        for line in (*wrong, *black):
            _wrapped(layout, line, "ERROR")
        for line in facts.notes(variant, setting):
            _wrapped(layout, line, "INFO")

    def _draw_settings(self, camera: Any) -> None:
        """Draw the shader's own parameters, which Cycles reads and keyframes change."""
        layout, custom = self.layout, camera.cycles_custom
        names = [n for n in _FIRST if n in custom] + [n for n in custom.keys() if n not in (*_FIRST, "few")]
        column = layout.column()
        column.prop(camera.dof, "focus_object")
        distance = column.row()
        distance.active = camera.dof.focus_object is None
        distance.prop(camera.dof, "focus_distance")
        for name in ("sensor_width", "shift_x", "shift_y"):
            column.prop(camera, name)
        for name in names:
            column.prop(custom, f'["{name}"]', text=_LABELS.get(name, name.capitalize()))


@bpy.app.handlers.persistent
def warn_of_black(scene: Any, _graph: Any = None) -> None:
    """Print a line, before a frame is rendered, if the lens cannot take the picture or a corner of it."""
    found = scene.camera
    if found is None or found.type != "CAMERA" or not on_camera.applied(found.data):
        return
    lens_id, _, kind = found.data.neurolens.on.partition("/")
    lens = LIBRARY.lenses.get(lens_id)
    if lens is not None and kind in lens.variants:
        asked = lens.variants[kind], on_camera.setting_of(scene, found)
        for line in (*facts.refusals(*asked), *facts.outside(*asked)):
            print(f"neurolens: camera {found.name!r}, frame {scene.frame_current}: {line}", file=sys.stderr)


_saved, _viewport = (
    bpy.app.handlers.persistent(lambda *_, render=render: on_camera.tell_samples(render)) for render in (True, False)
)
_rendered = bpy.app.handlers.persistent(lambda scene, *_: on_camera.tell_samples(True, scene))
HANDLERS = (  # by the list in `bpy.app.handlers` whose functions are called
    ("render_pre", warn_of_black), ("render_init", _rendered), ("render_complete", _viewport),
    ("render_cancel", _viewport), ("save_pre", _saved), ("save_post", _viewport), ("load_post", _viewport),
)  # fmt: skip


def _wrapped(layout: Any, text: str, icon: str) -> None:
    """Write a sentence in lines that the panel can show."""
    for number, line in enumerate(textwrap.wrap(text, 60, break_long_words=False)):
        layout.label(text=line, icon="BLANK1" if number else icon)


CLASSES = (
    CameraSettings, NEUROLENS_OT_apply, NEUROLENS_OT_find, NEUROLENS_OT_take_back, NEUROLENS_OT_needs,
    NEUROLENS_OT_reload, NEUROLENS_PT_lens,
)  # fmt: skip
