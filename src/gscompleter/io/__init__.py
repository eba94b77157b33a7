"""Reading and writing: Gaussians, posed photographs, cameras, images and output folders."""
