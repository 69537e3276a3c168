"""The float32 VAE of SDXL and Stable Diffusion, for pipelines of half-precision networks."""

from typing import Any

import torch
from diffusers.models.autoencoders.autoencoder_kl import AutoencoderKL


class ExactVae(AutoencoderKL):
    """An AutoencoderKL that takes pictures and latents of any dtype from any device.

    It converts them to its own dtype and moves them to its execution device, which differs from its storage device
    while it is offloaded. Latents come back in the input's dtype for the UNet; pictures come out in its own.
    """

    def encode(self, x: torch.Tensor, return_dict: bool = True) -> Any:
        """The posterior of pictures (n, 3, h, w) in -1..1."""
        (posterior,) = super().encode(self._brought(x), return_dict=False)
        parameters = posterior.parameters.to(x.dtype)
        answer = type(posterior)(parameters)
        if not return_dict:
            return (answer,)
        from diffusers.models.modeling_outputs import AutoencoderKLOutput

        return AutoencoderKLOutput(latent_dist=answer)

    def decode(self, z: torch.Tensor, return_dict: bool = True, generator: torch.Generator | None = None) -> Any:
        """Pictures of unscaled latents (n, 4, h, w)."""
        return super().decode(self._brought(z), return_dict=return_dict, generator=generator)

    def _brought(self, x: torch.Tensor) -> Any:
        device = getattr(getattr(self, "_hf_hook", None), "execution_device", None)
        return x.to(self.device if device is None else device, self.dtype)
