"""Members over processes (gloo): the same analysis, bit for bit, as in one."""

import pytest
import torch
import torch.distributed as dist
import torch.multiprocessing as multiprocessing

from torchsph.assimilation import (
    ETKF,
    LETKF,
    RTPS,
    AssimilationError,
    Distributed,
    Localisation,
    Observations,
    StochasticEnKF,
    member_slice,
)

MEMBERS = 7


def problem():
    draw = torch.Generator().manual_seed(0)
    place = torch.rand(30, 2, generator=draw)
    ensemble = torch.randn(MEMBERS, 60, generator=draw)
    value = torch.randn(30, generator=draw)
    return ensemble, ensemble[:, :30].clone(), Observations(value, torch.full((30,), 0.3), place), place


def filters():
    return [
        ETKF(rotation=True),
        StochasticEnKF(),
        LETKF(localisation=Localisation(0.5), inflation=RTPS(0.4)),
    ]


def work(rank: int, processes: int, folder: str) -> None:
    dist.init_process_group("gloo", init_method=f"file://{folder}/meet", rank=rank, world_size=processes)
    torch.set_num_threads(1)
    ensemble, predicted, observations, place = problem()
    own = member_slice(MEMBERS, rank, processes)
    results = [
        Distributed(filter_).analyse(
            ensemble[own],
            predicted[own],
            observations,
            state_positions=place,
            generator=torch.Generator().manual_seed(5),
        )
        for filter_ in filters()
    ]
    torch.save([(result.ensemble, result.mean) for result in results], f"{folder}/{rank}.pt")
    dist.destroy_process_group()


def check(parts: list) -> None:
    ensemble, predicted, observations, place = problem()
    for k, filter_ in enumerate(filters()):
        alone = filter_.analyse(
            ensemble,
            predicted,
            observations,
            state_positions=place,
            generator=torch.Generator().manual_seed(5),
        )
        assert torch.equal(torch.cat([part[k][0] for part in parts]), alone.ensemble)
        assert all(torch.equal(part[k][1], alone.mean) for part in parts)


def test_one_process_is_the_plain_filter(tmp_path):
    threads = torch.get_num_threads()
    work(0, 1, str(tmp_path))
    torch.set_num_threads(threads)
    check([torch.load(tmp_path / "0.pt")])


@pytest.mark.slow
@pytest.mark.parametrize("processes", [2, 3])
def test_ranks_do_not_change_the_result(tmp_path, processes):
    multiprocessing.spawn(work, (processes, str(tmp_path)), nprocs=processes)
    check([torch.load(tmp_path / f"{rank}.pt") for rank in range(processes)])


def test_members_are_shared_evenly():
    for total, processes in ((7, 2), (8, 3), (5, 5)):
        parts = [range(total)[member_slice(total, rank, processes)] for rank in range(processes)]
        assert [k for part in parts for k in part] == list(range(total))
        assert max(map(len, parts)) - min(map(len, parts)) <= 1
    with pytest.raises(AssimilationError, match="at least one member"):
        member_slice(2, 0, 3)
