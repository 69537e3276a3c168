"""What can be swapped, by name: each entry is "module:function", imported when it is first asked for."""

STYLIZERS = {"embedded": "mistyle.backends.embedded:solve_surface"}
INPAINTERS = {"fill": "mistyle.backends.fill:inpainter"}
