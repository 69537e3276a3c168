"""The Python API, as `import mistyle` exports it: readers and solvers that return records, and verbs that write."""

from mistyle.api.comparison import Comparison, compare
from mistyle.api.drawing import Views, render_views
from mistyle.api.jobs import JobResult, bake, fit, lookdev, stylize
from mistyle.api.reading import read_cameras, read_captures, read_lights, read_mesh, read_picture, read_views
from mistyle.api.recovery import MaterialFit, RecoverSettings, recover
from mistyle.api.scenes import SceneFit, fit_scene
from mistyle.api.showing import Gallery, gallery
from mistyle.core.asset import Asset
from mistyle.core.camera import Camera, look_at, orbit
from mistyle.core.capture import Captures
from mistyle.core.capture import in_memory as captures_of
from mistyle.core.capture import subset as subset_of
from mistyle.core.errors import MistyleError
from mistyle.core.light import Ambient, Directional, Environment, Point, SphericalGaussian
from mistyle.core.maps import Maps, flat_maps
from mistyle.core.mesh import Mesh
from mistyle.core.view import View
from mistyle.render.deferred.differentiable import Renderer

__all__ = [
    "Ambient",
    "Asset",
    "Camera",
    "Captures",
    "Comparison",
    "Directional",
    "Environment",
    "Gallery",
    "JobResult",
    "Maps",
    "MaterialFit",
    "Mesh",
    "MistyleError",
    "Point",
    "RecoverSettings",
    "Renderer",
    "SceneFit",
    "SphericalGaussian",
    "View",
    "Views",
    "bake",
    "captures_of",
    "compare",
    "fit",
    "fit_scene",
    "flat_maps",
    "gallery",
    "look_at",
    "lookdev",
    "orbit",
    "read_cameras",
    "read_captures",
    "read_lights",
    "read_mesh",
    "read_picture",
    "read_views",
    "recover",
    "render_views",
    "stylize",
    "subset_of",
]
