"""Pure image maths; the only SSIM in the house."""
