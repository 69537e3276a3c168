"""Stylizers, inpainters and maskers: functions of one signature each.

embedded       paints a whole surface once; embedded_view and diffusion make a Stylizer of views
               (`stylization/mvst/sweep.py`)
fill, paint3d  make an Inpainter of textures (`stylization/inpaint/repair.py`)
masks          makes a Masker of views
"""
