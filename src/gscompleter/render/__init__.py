"""Renderers: colour, z-depth and alpha of Gaussians seen from a camera.

All implement the 3DGS image formation of gsplat's classic mode: perspective EWA splatting with 0.3
px² added to the 2D covariance, contributions under alpha 1/255 dropped, alpha capped at 0.999,
compositing stopped when transmittance falls to 1e-4, colour over black. Antialiased Gaussians are
rendered as in gsplat's antialiased mode, which lowers opacities to compensate for that addition.
"""
