"""Generators Φ by feed-forward inpainting networks in the format ONNX: MI-GAN and LaMa.

Tested with tiny networks of the published signatures. Not tested: published weights, their images,
and a GPU.
"""
