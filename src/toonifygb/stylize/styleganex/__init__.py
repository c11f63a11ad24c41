"""StyleGANEX: faces of whole, unaligned frames translated by an encoder and a dilated StyleGAN2 generator."""
