"""Structure from motion: camera poses of photographs that have none."""
