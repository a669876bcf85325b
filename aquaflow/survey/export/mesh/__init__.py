"""A dive's surface as triangles: ranges drawn from the Gaussians, fused, coloured and written."""
