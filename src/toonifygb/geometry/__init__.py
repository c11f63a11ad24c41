"""Pure maths: rotations, cameras, spherical harmonics, skinning, meshes, alignment."""
