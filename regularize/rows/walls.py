"""Wall rows as arrays: where the wall is, its normal, its velocity, and how each row counts."""

from dataclasses import dataclass

import torch

from regularize.errors import InvalidInput

from .given import dense


@dataclass(frozen=True)
class WallRows:
    """Points on walls and orifices with the velocity the blood has there.

    Args:
        points: (n, D), m; (n, D + 1) with the time in s last.
        normals: (n, D), of any orientation and length: the row is n . v = n . velocity (Grønli 2017, eq. 3.21).
        velocity: (n, D), m/s: the moving wall's own, or the plug velocity of an open valve.
        weight: (n,), multiplies each row's square: the area it stands for; None: 1.
        no_slip: (n,) bool, rows whose full velocity vector, not only its normal part, equals ``velocity`` (False at
            open valves); None: all of them.

    Raises:
        InvalidInput: shapes that disagree, values that are not finite, a negative weight, a normal of length 0.
    """

    points: torch.Tensor
    normals: torch.Tensor
    velocity: torch.Tensor
    weight: torch.Tensor = None  # type: ignore[assignment]  # a tensor once built
    no_slip: torch.Tensor = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        points = dense("wall points", self.points)
        if points.ndim != 2 or len(points) == 0:
            raise InvalidInput(f"wall points have shape {tuple(points.shape)}: expected (n, D) with n >= 1")
        if not points.is_floating_point():
            points = points.double()
        convert = {"points": points}
        for name in ("normals", "velocity"):
            value = dense(f"wall {name}", getattr(self, name)).to(points)
            # points may carry the time as one more column than the vectors have
            if value.ndim != 2 or len(value) != len(points) or points.shape[1] - value.shape[1] not in (0, 1):
                raise InvalidInput(f"wall {name} have shape {tuple(value.shape)}: expected {tuple(points.shape)}")
            convert[name] = value
        if convert["velocity"].shape != convert["normals"].shape:
            shapes = f"{tuple(convert['normals'].shape)} and {tuple(convert['velocity'].shape)}"
            raise InvalidInput(f"wall normals and velocity have shapes {shapes}: they must agree")
        count = points.shape[:1]
        weight = torch.ones_like(points[:, 0]) if self.weight is None else dense("wall weight", self.weight).to(points)
        slip = torch.ones(count, dtype=torch.bool) if self.no_slip is None else dense("wall no_slip", self.no_slip)
        convert["weight"], convert["no_slip"] = weight, slip.bool().to(points.device)
        for name in ("weight", "no_slip"):
            if convert[name].shape != count:
                raise InvalidInput(f"wall {name} has shape {tuple(convert[name].shape)}: expected {tuple(count)}")
        for name in ("points", "normals", "velocity", "weight"):
            if not bool(torch.isfinite(convert[name]).all()):
                raise InvalidInput(f"wall {name} contain NaN or infinity: leave such rows out")
        if bool((weight < 0).any()):
            raise InvalidInput("wall weight has negative entries: weights must be >= 0")
        length = convert["normals"].norm(dim=1, keepdim=True)
        if bool((length == 0).any()):
            raise InvalidInput("wall normals contain a zero vector: leave degenerate triangles out")
        convert["normals"] = convert["normals"] / length
        for name, value in convert.items():
            object.__setattr__(self, name, value)

    def subset(self, keep: torch.Tensor) -> "WallRows":
        """The rows where ``keep`` (n,) is True."""
        return WallRows(
            self.points[keep], self.normals[keep], self.velocity[keep], self.weight[keep], self.no_slip[keep]
        )

    def to(self, dtype: torch.dtype, device: torch.device | str) -> "WallRows":
        """The same rows in another type, on another device."""
        fields = (self.points, self.normals, self.velocity, self.weight)
        points, normals, velocity, weight = (value.to(device=device, dtype=dtype) for value in fields)
        return WallRows(points, normals, velocity, weight, self.no_slip.to(device))
