"""SDXL's and Stable Diffusion's VAE, in float32 beside networks of half precision."""

from typing import Any

import torch
from diffusers.models.autoencoders.autoencoder_kl import AutoencoderKL


class ExactVae(AutoencoderKL):
    """An AutoencoderKL that takes pictures and latents of any type from any device.

    They go to its own type and to the device that it runs on, which is not where it lies while it is offloaded.
    Latents come back in the picture's type, as a network beside it wants them; pictures come out in its own.
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
        """Pictures of latents (n, 4, h, w), the scale of training taken off."""
        return super().decode(self._brought(z), return_dict=return_dict, generator=generator)

    def _brought(self, x: torch.Tensor) -> Any:
        device = getattr(getattr(self, "_hf_hook", None), "execution_device", None)
        return x.to(self.device if device is None else device, self.dtype)
