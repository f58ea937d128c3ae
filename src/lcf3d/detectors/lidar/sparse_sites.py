"""Sites, the active cells of sparse tensors: which input meets which output at every offset of a kernel."""

from __future__ import annotations

from typing import Any

from lcf3d.networks.torch import Tensor, torch

Triple = tuple[int, int, int]


class Sites:
    """Active cells of a sparse tensor.

    Args:
        coordinates: (N, 4) int64 ``batch, z, y, x``, all different.
        shape: cells along z, y, x.
        spconv_indices: what spconv has worked out about these sites.
    """

    def __init__(self, coordinates: Tensor, shape: Triple, spconv_indices: dict[str, Any] | None = None) -> None:
        self.coordinates = coordinates
        self.shape = shape
        self.spconv_indices = {} if spconv_indices is None else spconv_indices
        self._sorted_keys, self._order = torch.sort(flat_keys(coordinates, shape))
        self._submanifold: dict[Triple, Tensor] = {}
        self._strided: dict[tuple[Triple, Triple, Triple], tuple[Sites, Tensor]] = {}

    def __len__(self) -> int:
        return len(self.coordinates)

    def find(self, keys: Tensor) -> Tensor:
        """Index of the site with each of the flat keys, -1 where there is none."""
        if not len(self):
            return torch.full_like(keys, -1)
        position = torch.searchsorted(self._sorted_keys, keys).clamp_(max=len(self) - 1)
        return torch.where(self._sorted_keys[position] == keys, self._order[position], -1)

    def submanifold_table(self, kernel: Triple) -> Tensor:
        """(N, K) input of each site at each offset of an odd kernel; N where there is none."""
        if kernel not in self._submanifold:
            offsets = kernel_offsets(kernel, self.coordinates.device)
            half = len(offsets) // 2
            steps = offsets[:half] - torch.tensor(kernel, device=offsets.device) // 2
            cells = self.coordinates[None].repeat(half, 1, 1)
            cells[:, :, 1:] += steps[:, None]
            flat = cells.reshape(-1, 4)
            found = torch.where(inside(flat, self.shape), self.find(flat_keys(flat, self.shape)), -1).reshape(half, -1)
            table = torch.full((len(self), len(offsets)), len(self), device=offsets.device)
            table[:, half] = torch.arange(len(self), device=offsets.device)
            offset, output = torch.nonzero(found >= 0, as_tuple=True)
            source = found[offset, output]
            table[output, offset] = source
            # offset k from A to B is the mirrored offset from B to A
            table[source, len(offsets) - 1 - offset] = output
            self._submanifold[kernel] = table
        return self._submanifold[kernel]

    def strided_table(self, kernel: Triple, stride: Triple, padding: Triple) -> tuple[Sites, Tensor]:
        """Output sites, every cell that an input reaches, and the output of each input at each offset (N, K).

        Where an input reaches none, the table holds the number of outputs.
        """
        key = (kernel, stride, padding)
        if key not in self._strided:
            self._strided[key] = self._stride(kernel, stride, padding)
        return self._strided[key]

    def _stride(self, kernel: Triple, stride: Triple, padding: Triple) -> tuple[Sites, Tensor]:
        sizes = [(n + 2 * p - k) // s + 1 for n, k, s, p in zip(self.shape, kernel, stride, padding, strict=True)]
        shape = (sizes[0], sizes[1], sizes[2])
        offsets = kernel_offsets(kernel, self.coordinates.device)
        cells = self.coordinates[None].repeat(len(offsets), 1, 1)
        cells[:, :, 1:] += (torch.tensor(padding, device=offsets.device) - offsets)[:, None]
        step = torch.tensor(stride, device=offsets.device)
        whole = (cells[:, :, 1:] % step == 0).all(dim=2)
        cells[:, :, 1:] = torch.div(cells[:, :, 1:], step, rounding_mode="floor")
        reached = whole & inside(cells.reshape(-1, 4), shape).reshape(whole.shape)
        offset, inputs = torch.nonzero(reached, as_tuple=True)
        keys, inverse = torch.unique(flat_keys(cells[reached], shape), return_inverse=True)
        # outputs stand in the order in which spconv meets them: offset by offset, of each the inputs in their order
        arrival = offset * len(self) + inputs
        first = torch.full_like(keys, len(self) * len(offsets)).scatter_reduce(0, inverse, arrival, "amin")
        order = first.argsort()
        rank = torch.empty_like(order)
        rank[order] = torch.arange(len(order), device=order.device)
        table = torch.full((len(self), len(offsets)), len(order), device=offsets.device)
        table[inputs, offset] = rank[inverse]
        return Sites(coordinates_of(keys[order], shape), shape), table


def swap_table(table: Tensor, rows: int) -> Tensor:
    """The table of the opposite direction: (rows, K) from one of N rows with entries below ``rows`` or none."""
    source, offset = torch.nonzero(table < rows, as_tuple=True)
    swapped = torch.full((rows, table.shape[1]), len(table), device=table.device)
    swapped[table[source, offset], offset] = source
    return swapped


def kernel_offsets(kernel: Triple, device: Any) -> Tensor:
    """(K, 3) offsets of a kernel along z, y, x, in row-major order."""
    return torch.cartesian_prod(*(torch.arange(k, device=device) for k in kernel)).reshape(-1, 3)


def flat_keys(coordinates: Tensor, shape: Triple) -> Tensor:
    """(N,) one number for each (N, 4) cell."""
    batch, z, y, x = coordinates.unbind(1)
    return ((batch * shape[0] + z) * shape[1] + y) * shape[2] + x


def coordinates_of(keys: Tensor, shape: Triple) -> Tensor:
    """(N, 4) cells of flat keys."""
    rest, x = torch.div(keys, shape[2], rounding_mode="floor"), keys % shape[2]
    rest, y = torch.div(rest, shape[1], rounding_mode="floor"), rest % shape[1]
    return torch.stack([torch.div(rest, shape[0], rounding_mode="floor"), rest % shape[0], y, x], dim=1)


def inside(coordinates: Tensor, shape: Triple) -> Tensor:
    """(N,) whether each (N, 4) cell lies in the grid."""
    cells = coordinates[:, 1:]
    return ((cells >= 0) & (cells < torch.tensor(shape, device=cells.device))).all(dim=1)
