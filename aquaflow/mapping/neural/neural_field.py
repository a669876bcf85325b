"""Groups, features and decoder of one sub-map: what is decoded, and not how it is learned."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from aquaflow.config.mapping import DecoderConfig
from aquaflow.mapping.gaussians.gaussians import GaussianMap
from aquaflow.mapping.neural.decode import decode, decoded_torch
from aquaflow.mapping.neural.decoder import Decoder, Trunk
from aquaflow.mapping.neural.observation import observation
from aquaflow.mapping.neural.tokens import Tokens, visible_tokens
from aquaflow.mapping.neural.voxel_groups import VoxelGroups
from aquaflow.render.transfers import weights_in


class NeuralField:
    """f_l of each Gaussian, f_g of each voxel group, and LGPD, which decodes them."""

    def __init__(
        self,
        config: DecoderConfig,
        gaussians: GaussianMap,
        generator: torch.Generator,
        threads: int,
    ) -> None:
        self.config, self.gaussians, self.threads = config, gaussians, threads
        self.device = gaussians.device
        size = (len(gaussians), config.local_width)
        gaussians.local_features = torch.zeros(size, device=self.device)
        self.groups = VoxelGroups(config.voxels, config.global_width, self.device)
        self.decoder = weights_in(Decoder(config, generator), self.device)

    @property
    def local(self) -> Tensor:
        """[N, F_l] feature of each Gaussian."""
        return self.gaussians.local_features

    @property
    def shared(self) -> Tensor:
        """[G, F_g] feature of each group."""
        return self.groups.features

    def context(
        self,
        seen: Sequence[Tensor],  # each [N] bool
    ) -> Tensor:
        """[N] bool: what a trunk is made of, for views that show ``seen``."""
        if not self.config.visible_groups:
            return self.everyone()
        return torch.stack(list(seen)).any(dim=0)

    def everyone(self) -> Tensor:
        """[N] bool, all True."""
        return torch.ones(len(self.gaussians), dtype=torch.bool, device=self.device)

    def trunk(
        self,
        seen: Tensor,  # [N] bool
        centres: Tensor,  # [3] or [N, 3] of the cameras
        features: tuple[Tensor, Tensor] | None = None,  # [N, F_l] and [G, F_g]
    ) -> Trunk:
        """The trunk of the groups with a Gaussian in ``seen``; of ``features``, if given, in place
        of the field's own."""
        tokens = visible_tokens(self.groups, seen)
        local, shared = features or (self.local, self.shared)
        return self.decoder.trunk(tokens, local, shared, self._observation(tokens, centres))

    def decode(
        self,
        trunk: Trunk,
        seen: Tensor,  # [N] bool
        parameters: Mapping[str, Tensor],  # of a GaussianMap
        viewmat: Tensor,  # [4, 4]
    ) -> dict[str, Tensor]:
        """The parameters as the camera of ``viewmat`` sees them; differentiable."""
        centre, places = camera_centre(viewmat), trunk.tokens.places(seen)
        return decode(self.decoder, trunk, parameters, places, centre, self.threads)

    @torch.no_grad()
    def bake_parameters(
        self,
        centres: Tensor,  # [N, 3] of the camera that each Gaussian is seen from
    ) -> dict[str, Tensor]:
        """All parameters as plain Gaussians, each as its own camera sees it."""
        everyone = self.everyone()
        trunk = self.trunk(everyone, centres)
        places = trunk.tokens.places(everyone)
        rows = trunk.tokens.rows[places]
        return decoded_torch(self.decoder, trunk, self.gaussians.parameters, places, centres[rows])

    def _observation(
        self,
        tokens: Tokens,
        centres: Tensor,  # [3], or [N, 3] of the camera that each Gaussian is seen from
    ) -> Tensor | None:
        """[P, 4] what the trunk takes; None where the observation enters after the attention."""
        if not self.decoder.observes_first:
            return None
        centre = centres if centres.dim() == 1 else centres[tokens.rows]
        return observation(self.gaussians.means.detach()[tokens.rows], centre)


def camera_centre(
    viewmat: Tensor,  # [4, 4] world to camera
) -> Tensor:
    """[3] world; no gradient."""
    viewmat = viewmat.detach()
    return -viewmat[:3, :3].T @ viewmat[:3, 3]
