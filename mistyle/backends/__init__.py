"""What can be swapped, by name: each entry is "module:function", imported when it is first asked for."""

# `embedded` paints a whole surface; the others make a Stylizer of views (see `mistyle.stages.mvst`).
STYLIZERS = {
    "embedded": "mistyle.backends.embedded:solve_surface",
    "embedded-view": "mistyle.backends.embedded_view:stylizer",
    "diffusion": "mistyle.backends.diffusion:stylizer",
}
INPAINTERS = {
    "fill": "mistyle.backends.fill:inpainter",
    "paint3d": "mistyle.backends.paint3d:inpainter",
}
