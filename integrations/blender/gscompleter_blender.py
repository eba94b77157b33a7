"""Add-on of Blender: a completed splat as points with its cameras, and masks from your camera.

It is one file and needs nothing but Blender; gscompleter runs outside of it. The frame of a splat's
file has y down and z forward, that of Blender z up: what is imported hangs on an empty that turns
it, and whatever is written is turned back. Cameras of Blender look along -z with y up, as those of
a `transforms.json`, so that their matrices are the same numbers.
"""

import json
import math
import shlex
import struct
import zlib
from pathlib import Path

import bpy
import numpy as np

bl_info = {
    "name": "gscompleter",
    "description": "Imports completed splats with their cameras, and marks what is to be repaired",
    "author": "gscompleter",
    "version": (0, 1, 0),
    "blender": (4, 2, 0),
    "location": "View3D > Sidebar > gscompleter",
    "category": "Import-Export",
}

FROM_FILE = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""From the frame of a splat's file (y down, z forward) to that of Blender (y forward, z up)."""
SH_0 = 0.28209479177387814
"""Value of the first spherical harmonic."""
SENSOR = 36.0
"""Width of the sensor of imported cameras, in millimetres."""
TARGETS = "targets.json"
"""File with the cameras of a result, beside completed.ply."""
MASK = "gscompleter mask"
"""Name of the image that is painted on."""
SHOWN = "rgb"
"""Attribute with the colour of points; from one named `color`, Cycles renders points black."""
INVENTED = (1.0, 0.0, 1.0)
"""Colour of what was invented, in the attribute `origin`."""
TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "<i2",
    "int16": "<i2",
    "ushort": "<u2",
    "uint16": "<u2",
    "int": "<i4",
    "int32": "<i4",
    "uint": "<u4",
    "uint32": "<u4",
    "float": "<f4",
    "float32": "<f4",
    "double": "<f8",
    "float64": "<f8",
}


class GscompleterError(Exception):
    """Tell a person in one sentence what is wrong and what to do."""


# -------------------------------------------------------------------------------------- files


def read_points(path: Path) -> dict[str, np.ndarray]:
    """Read the Gaussians of a plain .ply as points.

    Returns `position` [n, 3] in the frame of the file, `color` [n, 3] in sRGB from 0 to 1,
    `opacity` [n], and `generated` [n]: 0 for what was measured.
    """
    head, mark, body = path.read_bytes().partition(b"end_header\n")
    words = [line.split() for line in head.decode("utf-8", "replace").splitlines()]
    named = [(w[2], TYPES.get(w[1])) for w in words if w[:1] == ["property"] and len(w) == 3]
    elements = [w for w in words if w[:1] == ["element"]]
    needed = {"x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"}
    is_binary = mark and words[:2] == [["ply"], ["format", "binary_little_endian", "1.0"]]
    is_splat = len(elements) == 1 and needed <= dict(named).keys()
    if not is_binary or not is_splat or None in dict(named).values():
        raise GscompleterError(
            f"{path.name} is no plain .ply of Gaussians; choose the completed.ply of a result, or "
            "turn it into one with: gscompleter convert"
        )
    table = np.frombuffer(body, np.dtype(named), count=int(elements[0][2]))

    def stack(*names: str) -> np.ndarray:
        return np.stack([table[name].astype(np.float32) for name in names], axis=1)

    labels = (
        table["generated"] if "generated" in (table.dtype.names or ()) else np.zeros(len(table))
    )
    return {
        "position": stack("x", "y", "z"),
        "color": np.clip(0.5 + SH_0 * stack("f_dc_0", "f_dc_1", "f_dc_2"), 0, 1),
        "opacity": 1 / (1 + np.exp(-table["opacity"].astype(np.float32))),
        "generated": np.asarray(labels, np.int32),
    }


def read_frames(path: Path) -> list[dict]:
    """Read the cameras of a `transforms.json`."""
    try:
        content = json.loads(path.read_text("utf-8"))
        shared = {
            key: content[key] for key in ("fl_x", "fl_y", "cx", "cy", "w", "h") if key in content
        }
        return [{**shared, **frame} for frame in content["frames"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise GscompleterError(f"{path.name} is no file of cameras: {error}") from error


def write_camera(path: Path, frame: dict) -> None:
    """Write a file with one camera, which `--target` reads."""
    path.write_text(json.dumps({"camera_model": "PINHOLE", "frames": [frame]}, indent=1), "utf-8")


def write_mask(path: Path, mask: np.ndarray) -> None:
    """Write a mask [h, w] as a grey .png: white where True, the first row on top."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        ending = struct.pack(">I", zlib.crc32(kind + data))
        return struct.pack(">I", len(data)) + kind + data + ending

    height, width = mask.shape
    # Each row begins with its filter, of which 0 is none.
    rows = np.zeros((height, width + 1), np.uint8)
    rows[:, 1:] = np.where(mask, 255, 0)
    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    parts = [
        chunk(b"IHDR", head),
        chunk(b"IDAT", zlib.compress(rows.tobytes())),
        chunk(b"IEND", b""),
    ]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))


# ---------------------------------------------------------------------------------------- maths


def compute_lens(frame: dict) -> dict[str, float]:
    """Return lens in millimetres and shifts for a camera of a file, with a horizontal sensor."""
    width, height = frame["w"], frame["h"]
    return {
        "lens": frame["fl_x"] * SENSOR / width,
        "shift_x": (width / 2 - frame["cx"]) / width,
        "shift_y": (frame["cy"] - height / 2) / width,
    }


def compute_intrinsics(
    lens: float,
    sensor: tuple[float, float],
    fit: str,
    shift: tuple[float, float],
    size: tuple[int, int],
) -> dict[str, float]:
    """Return focal lengths and the principal point in pixels of a camera of Blender.

    `sensor` is its width and height in millimetres, `size` the width and height of the image.
    """
    width, height = size
    is_wide = fit == "HORIZONTAL" or (fit == "AUTO" and width >= height)
    # With AUTO the width of the sensor is that of the longer side, whichever it is.
    side = width if is_wide else height
    focal = lens / (sensor[1] if fit == "VERTICAL" else sensor[0]) * side
    return {
        "fl_x": focal,
        "fl_y": focal,
        "cx": width / 2 - shift[0] * side,
        "cy": height / 2 + shift[1] * side,
        "w": width,
        "h": height,
    }


def move_to_file(camera: np.ndarray, frame: np.ndarray) -> np.ndarray:
    """Return the matrix of a camera in the frame of a splat's file.

    `camera` is its matrix in Blender's world, and `frame` that of the object which the splat is:
    a rotation, a shift and one scale.
    """
    scale = np.cbrt(np.linalg.det(frame[:3, :3]))
    turned = frame[:3, :3] / scale if scale > 0 else np.zeros((3, 3))
    if not np.allclose(turned @ turned.T, np.eye(3), atol=1e-4):
        raise GscompleterError(
            "The splat is stretched or mirrored; give it one scale for all axes."
        )
    local = np.linalg.inv(frame) @ camera
    # Without the scale of the splat and of the camera, which changes nothing that it sees.
    local[:3, :3] /= np.linalg.norm(local[:3, :3], axis=0)
    return local


def fill_polygon(points: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Mark the pixels [h, w] whose centres are in a closed polygon [n, 2] of x, y from above."""
    width, height = size
    x = np.arange(width) + 0.5
    inside = np.zeros((height, width), bool)
    for row in range(height):
        y = row + 0.5
        for (x0, y0), (x1, y1) in zip(points, np.roll(points, -1, axis=0), strict=True):
            # Each edge that is left of a pixel turns inside to outside, and back.
            if (y0 <= y) != (y1 <= y):
                inside[row] ^= x > x0 + (y - y0) / (y1 - y0) * (x1 - x0)
    return inside


# ------------------------------------------------------------------------------- Blender's data


def add_points(
    points: dict[str, np.ndarray], name: str, parent: bpy.types.Object
) -> bpy.types.Object:
    """Add points as vertices with attributes, which Blender draws as points of their colour."""
    count = len(points["position"])
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(count)
    mesh.vertices.foreach_set("co", points["position"].astype(np.float32).ravel())
    is_invented = points["generated"] > 0
    origin = np.where(is_invented[:, None], np.array(INVENTED, np.float32), points["color"])
    for key, color in ((SHOWN, points["color"]), ("origin", origin)):
        attribute = mesh.attributes.new(key, "FLOAT_COLOR", "POINT")
        linear = np.ones((count, 4), np.float32)
        linear[:, :3] = decode_srgb(color)
        attribute.data.foreach_set("color", linear.ravel())
    for key, kind, type_ in (("opacity", "FLOAT", np.float32), ("generated", "INT", np.int32)):
        attribute = mesh.attributes.new(key, kind, "POINT")
        attribute.data.foreach_set("value", np.ascontiguousarray(points[key], type_))
    mesh.update()
    thing = bpy.data.objects.new(name, mesh)
    thing.parent = parent
    bpy.context.scene.collection.objects.link(thing)
    draw_as_points(thing, points["position"])
    return thing


def decode_srgb(color: np.ndarray) -> np.ndarray:
    """Return linear values, in which Blender keeps its colours."""
    return np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)


def draw_as_points(thing: bpy.types.Object, position: np.ndarray) -> None:
    """Draw the vertices of an object as points, by a modifier and a material of their colours."""
    material = bpy.data.materials.new("gscompleter color")
    # Since Blender 5.0 materials have nodes from the beginning.
    if material.node_tree is None:
        material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    color = nodes.new("ShaderNodeAttribute")
    color.attribute_name = SHOWN
    light = nodes.new("ShaderNodeEmission")
    output = nodes.new("ShaderNodeOutputMaterial")
    links.new(color.outputs["Color"], light.inputs["Color"])
    links.new(light.outputs["Emission"], output.inputs["Surface"])
    thing.data.materials.append(material)

    tree = bpy.data.node_groups.new("gscompleter points", "GeometryNodeTree")
    tree.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    begin, end = tree.nodes.new("NodeGroupInput"), tree.nodes.new("NodeGroupOutput")
    points = tree.nodes.new("GeometryNodeMeshToPoints")
    # About half of the distance of neighbours, if they lay in a plane.
    spread = np.std(position, axis=0).max() if len(position) else 1.0
    points.inputs["Radius"].default_value = float(spread / math.sqrt(max(len(position), 1)))
    paint = tree.nodes.new("GeometryNodeSetMaterial")
    paint.inputs["Material"].default_value = material
    tree.links.new(begin.outputs[0], points.inputs["Mesh"])
    tree.links.new(points.outputs["Points"], paint.inputs["Geometry"])
    tree.links.new(paint.outputs["Geometry"], end.inputs[0])
    thing.modifiers.new("gscompleter points", "NODES").node_group = tree


def add_camera(frame: dict, name: str, parent: bpy.types.Object) -> bpy.types.Object:
    """Add a camera of a file."""
    data = bpy.data.cameras.new(name)
    data.sensor_fit = "HORIZONTAL"
    data.sensor_width = SENSOR
    for key, value in compute_lens(frame).items():
        setattr(data, key, value)
    thing = bpy.data.objects.new(name, data)
    thing.parent = parent
    thing.matrix_local = to_matrix(np.array(frame["transform_matrix"], float))
    bpy.context.scene.collection.objects.link(thing)
    return thing


def to_matrix(values: np.ndarray) -> object:
    """Return a matrix of Blender."""
    from mathutils import Matrix

    return Matrix([[float(value) for value in row] for row in values])


def import_result(path: Path) -> bpy.types.Object:
    """Import a splat with the cameras beside it; returns the empty that both hang on."""
    points = read_points(path)
    cameras = path.with_name(TARGETS)
    frames = read_frames(cameras) if cameras.is_file() else []
    root = bpy.data.objects.new(f"gscompleter {path.parent.name}", None)
    root.matrix_world = to_matrix(FROM_FILE)
    root["splat"] = str(path)
    bpy.context.scene.collection.objects.link(root)
    add_points(points, path.stem, root)
    added = [add_camera(frame, f"target {n}", root) for n, frame in enumerate(frames, start=1)]
    if added:
        render = bpy.context.scene.render
        render.resolution_x, render.resolution_y = int(frames[0]["w"]), int(frames[0]["h"])
        render.resolution_percentage = 100
        bpy.context.scene.camera = added[0]
    bpy.context.view_layer.update()
    return root


def get_size(scene: bpy.types.Scene) -> tuple[int, int]:
    """Return the width and height of the image of a scene."""
    render = scene.render
    share = render.resolution_percentage / 100
    if not math.isclose(render.pixel_aspect_x, render.pixel_aspect_y):
        raise GscompleterError("The pixels are not square; set both aspects of the output to 1.")
    return round(render.resolution_x * share), round(render.resolution_y * share)


def describe_camera(scene: bpy.types.Scene, splat: bpy.types.Object) -> dict:
    """Describe the camera of a scene by the keys of a `transforms.json`, in the splat's frame."""
    camera = scene.camera
    if camera is None:
        raise GscompleterError("The scene has no camera; add one, and look through it.")
    data = camera.data
    if data.type != "PERSP":
        raise GscompleterError("The camera is not perspective; change its type.")
    frame: dict = compute_intrinsics(
        data.lens,
        (data.sensor_width, data.sensor_height),
        data.sensor_fit,
        (data.shift_x, data.shift_y),
        get_size(scene),
    )
    matrix = move_to_file(np.array(camera.matrix_world), np.array(splat.matrix_world))
    return {**frame, "transform_matrix": matrix.tolist()}


def find_splat(context: bpy.types.Context) -> bpy.types.Object:
    """Return the object that a splat is: the chosen one, or what it hangs on."""
    chosen = context.scene.gscompleter_splat
    if chosen is None:
        raise GscompleterError("No splat is chosen; import one, or choose the object that it is.")
    return chosen


def find_folder(context: bpy.types.Context) -> Path:
    """Return the folder to write to."""
    folder = context.scene.gscompleter_folder
    if folder.startswith("//") and not bpy.data.filepath:
        raise GscompleterError("The scene has no file yet; save it, or choose another folder.")
    return Path(bpy.path.abspath(folder))


def read_mask(size: tuple[int, int]) -> np.ndarray:
    """Return what is marked [h, w], the first row on top; nothing if the size is another one."""
    width, height = size
    image = bpy.data.images.get(MASK)
    if image is None or tuple(image.size) != size:
        return np.zeros((height, width), bool)
    pixels = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(pixels)
    # Rows of Blender's images begin below.
    return pixels.reshape(height, width, 4)[::-1, :, 0] > 0.5


def add_to_mask(marked: np.ndarray) -> None:
    """Mark pixels [h, w] besides what is marked, the first row on top."""
    height, width = marked.shape
    mask = marked | read_mask((width, height))
    # Undo gives back images that were there before, but not the pixels that one had before; so each
    # mask is an image of its own, packed, which the file of the scene keeps, too.
    image = bpy.data.images.new(MASK, width, height, alpha=False)
    pixels = np.ones((height, width, 4), np.float32)
    pixels[..., :3] = mask[::-1, :, None]
    image.pixels.foreach_set(pixels.ravel())
    image.pack()
    image.use_fake_user = True
    earlier = bpy.data.images.get(MASK)
    if earlier not in (None, image):
        earlier.user_remap(image)
        bpy.data.images.remove(earlier)
        image.name = MASK


def write_repair(context: bpy.types.Context) -> str:
    """Write the camera and the mask; returns the command that repairs."""
    splat = find_splat(context)
    frame = describe_camera(context.scene, splat)
    image, size = bpy.data.images.get(MASK), get_size(context.scene)
    if image is not None and tuple(image.size) != size:
        raise GscompleterError("The size of the output changed since it was marked; mark it again.")
    mask = read_mask(size)
    if not mask.any():
        raise GscompleterError("Nothing is marked; draw around what is wrong first.")
    folder = find_folder(context)
    folder.mkdir(parents=True, exist_ok=True)
    write_camera(folder / "camera.json", frame)
    write_mask(folder / "mask.png", mask)
    source = splat.get("splat") or "splat.ply"
    words = ["gscompleter", "repair", str(source), "--target", str(folder / "camera.json")]
    words += ["--mask", str(folder / "mask.png"), "--out", str(folder / "repaired")]
    return shlex.join(words)


# ------------------------------------------------------------------------------------ interface


class GSC_OT_import(bpy.types.Operator):  # noqa: N801
    """Import a completed splat as points, with the cameras of its targets."""

    bl_description = "Import a completed splat as points, with the cameras of its targets"
    bl_idname = "gscompleter.import_result"
    bl_label = "Import result"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012
    filepath: bpy.props.StringProperty(subtype="FILE_PATH")
    filter_glob: bpy.props.StringProperty(default="*.ply", options={"HIDDEN"})

    def invoke(self, context, event):
        """Ask for the file."""
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context):
        """Import it."""
        try:
            context.scene.gscompleter_splat = import_result(Path(bpy.path.abspath(self.filepath)))
        except (GscompleterError, OSError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return {"FINISHED"}


class GSC_OT_mark(bpy.types.Operator):  # noqa: N801
    """Draw around what is wrong, in the view of the camera; Esc cancels."""

    bl_description = "Draw around what is wrong, in the view of the camera; Esc cancels"
    bl_idname = "gscompleter.mark"
    bl_label = "Draw around what is wrong"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context):
        """Allow it in a view through the camera."""
        space = context.space_data
        return (
            space is not None
            and space.type == "VIEW_3D"
            and (space.region_3d.view_perspective == "CAMERA")
        )

    def invoke(self, context, event):
        """Begin to follow the mouse."""
        self._path = []
        self._handle = bpy.types.SpaceView3D.draw_handler_add(
            self._draw, (), "WINDOW", "POST_PIXEL"
        )
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        """Follow the mouse while its button is down."""
        if event.type in {"ESC", "RIGHTMOUSE"}:
            return self._end(context, {"CANCELLED"})
        if event.type == "MOUSEMOVE" and self._path:
            self._path.append((event.mouse_region_x, event.mouse_region_y))
            context.area.tag_redraw()
        if event.type == "LEFTMOUSE" and event.value == "PRESS":
            self._path = [(event.mouse_region_x, event.mouse_region_y)]
        if event.type == "LEFTMOUSE" and event.value == "RELEASE":
            try:
                self._mark(context)
            except GscompleterError as error:
                self.report({"ERROR"}, str(error))
                return self._end(context, {"CANCELLED"})
            return self._end(context, {"FINISHED"})
        return {"RUNNING_MODAL"}

    def _end(self, context, result):
        bpy.types.SpaceView3D.draw_handler_remove(self._handle, "WINDOW")
        context.area.tag_redraw()
        return result

    def _draw(self):
        from gpu_extras.batch import batch_for_shader

        import gpu

        if len(self._path) < 2:
            return
        shader = gpu.shader.from_builtin("UNIFORM_COLOR")
        shader.uniform_float("color", (*INVENTED, 1.0))
        batch_for_shader(shader, "LINE_LOOP", {"pos": self._path}).draw(shader)

    def _mark(self, context):
        size = get_size(context.scene)
        corners = find_frame(context)
        add_to_mask(fill_polygon(move_to_image(self._path, corners, size), size))


def find_frame(context: bpy.types.Context) -> np.ndarray:
    """Return the corners [2, 2] of the camera's frame in the window: left below, right above."""
    from bpy_extras.view3d_utils import location_3d_to_region_2d

    camera = context.scene.camera
    corners = [
        camera.matrix_world @ corner for corner in camera.data.view_frame(scene=context.scene)
    ]
    shown = [location_3d_to_region_2d(context.region, context.region_data, c) for c in corners]
    points = np.array([tuple(point) for point in shown])
    return np.stack([points.min(axis=0), points.max(axis=0)])


def move_to_image(path: list, corners: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return points of the window, whose y goes up, in pixels of the camera's image from above."""
    share = (np.array(path, float) - corners[0]) / (corners[1] - corners[0])
    return np.stack([share[:, 0] * size[0], (1 - share[:, 1]) * size[1]], axis=1)


class GSC_OT_clear(bpy.types.Operator):  # noqa: N801
    """Forget what is marked."""

    bl_description = "Forget what is marked"
    bl_idname = "gscompleter.clear"
    bl_label = "Clear the mask"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def execute(self, context):
        """Remove the image of the mask."""
        image = bpy.data.images.get(MASK)
        if image is not None:
            bpy.data.images.remove(image)
        return {"FINISHED"}


class GSC_OT_write(bpy.types.Operator):  # noqa: N801
    """Write camera.json and mask.png, and copy the command that repairs."""

    bl_description = "Write camera.json and mask.png, and copy the command that repairs"
    bl_idname = "gscompleter.write"
    bl_label = "Write camera and mask"

    def execute(self, context):
        """Write them, and leave the command in the clipboard."""
        try:
            command = write_repair(context)
        except (GscompleterError, OSError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        context.window_manager.clipboard = command
        self.report({"INFO"}, f"Copied: {command}")
        return {"FINISHED"}


class GSC_PT_panel(bpy.types.Panel):  # noqa: N801
    """The buttons, in the order in which they are used."""

    bl_idname = "GSC_PT_panel"
    bl_label = "gscompleter"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "gscompleter"

    def draw(self, context):
        """Draw them."""
        layout = self.layout
        layout.operator(GSC_OT_import.bl_idname)
        layout.prop(context.scene, "gscompleter_splat")
        layout.operator(GSC_OT_mark.bl_idname)
        layout.operator(GSC_OT_clear.bl_idname)
        layout.prop(context.scene, "gscompleter_folder")
        layout.operator(GSC_OT_write.bl_idname)


CLASSES = (GSC_OT_import, GSC_OT_mark, GSC_OT_clear, GSC_OT_write, GSC_PT_panel)


def register() -> None:
    """Add the panel and its settings; Blender calls it."""
    for class_ in CLASSES:
        bpy.utils.register_class(class_)
    bpy.types.Scene.gscompleter_splat = bpy.props.PointerProperty(
        type=bpy.types.Object,
        name="Splat",
        description="The object that the splat is, also one that another add-on imported",
    )
    bpy.types.Scene.gscompleter_folder = bpy.props.StringProperty(
        name="Folder", default="//gscompleter", subtype="DIR_PATH"
    )


def unregister() -> None:
    """Take the panel away; Blender calls it."""
    del bpy.types.Scene.gscompleter_folder
    del bpy.types.Scene.gscompleter_splat
    for class_ in reversed(CLASSES):
        bpy.utils.unregister_class(class_)
