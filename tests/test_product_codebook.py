"""A codebook per choice: what a latent of several blocks decodes to."""

import pytest
import torch as th

from sb3_chdp.chdp.codebook import Codebook
from sb3_chdp.chdp.product_codebook import ProductCodebook
from sb3_chdp.common.product_table import block_widths, random_values

RADICES = (3, 2, 5, 1)


def test_blocks_are_as_wide_as_they_need_to_be():
    assert block_widths(RADICES, 8) == (2, 1, 4, 1)
    assert block_widths(RADICES, 2) == (2, 1, 2, 1)
    assert block_widths((64,), 8) == (8,)
    assert ProductCodebook((2,) * 77, 8).latent_dim == 77


def codewords_of(codebook, choice):
    """:return: the codewords of one choice, in its block of the latent"""
    k = th.zeros(RADICES[choice], len(RADICES), dtype=th.long)
    k[:, choice] = th.arange(RADICES[choice])
    start = sum(block_widths(RADICES, 3)[:choice])
    return codebook(k)[:, start : start + block_widths(RADICES, 3)[choice]]


@pytest.mark.parametrize("masked", [False, True])
def test_nearest_codewords_block_by_block(masked):
    th.manual_seed(0)
    codebook = ProductCodebook(RADICES, 3)
    latents = th.rand(200, codebook.latent_dim) * 2 - 1
    masks = (th.rand(200, sum(RADICES)) < 0.5) if masked else None
    if masks is not None:
        masks[:, [0, 3, 5, 10]] = True
    k = codebook.quantize(latents, masks)
    blocks = latents.split(block_widths(RADICES, 3), dim=1)
    for choice, block in enumerate(blocks):
        distances = th.cdist(block, codewords_of(codebook, choice))
        if masks is not None:
            distances = distances.masked_fill(~masks.split(RADICES, dim=1)[choice], th.inf)
        assert (k[:, choice] == distances.argmin(dim=1)).all()


def test_choices_in_any_order():
    """Of one long choice between short ones each has no more codewords than values, and decodes to its own."""
    th.manual_seed(0)
    radices = (2, 3, 50, 2, 3, 2)
    codebook = ProductCodebook(radices, 4)
    assert sum(table.numel() for table in codebook.parameters()) == sum(
        radix * width for radix, width in zip(radices, block_widths(radices, 4), strict=True)
    )
    k = random_values(radices, (300,))
    latents = codebook.representative_latents(k)
    assert th.equal(codebook.quantize(latents), k)
    # A value that may not be taken changes its own choice alone
    choice, offsets = 4, th.tensor((0, *radices[:-1])).cumsum(dim=0)
    masks = th.ones(300, sum(radices), dtype=th.bool).scatter(1, (offsets + k)[:, [choice]], False)
    other = codebook.quantize(latents, masks)
    assert ((other != k) == (th.arange(len(radices)) == choice)).all()
    # Only the columns of that choice differ
    differs = codebook(other) != codebook(k)
    assert th.equal(differs, (codebook.choice_of_column == choice).expand_as(differs))


def test_a_single_choice_is_the_codebook():
    th.manual_seed(0)
    codebook, product = Codebook(9, 4), ProductCodebook((9,), 4)
    with th.no_grad():
        product.tables[0][0] = codebook.codewords
    latents, k = th.rand(50, 4) * 2 - 1, th.randint(9, (50,))
    assert (product.quantize(latents)[:, 0] == codebook.quantize(latents)).all()
    assert (product(k[:, None]) == codebook(k)).all()
    assert (product.representative_latents(k[:, None]) == codebook.representative_latents(k)).all()


def test_codewords_decode_to_themselves_and_learn():
    th.manual_seed(0)
    codebook = ProductCodebook(RADICES, 3)
    k = random_values(RADICES, (4, 50))
    assert k.shape == (4, 50, 4) and all(set(k[..., i].flatten().tolist()) == set(range(n)) for i, n in enumerate(RADICES))
    latents = codebook.representative_latents(k)
    assert latents.shape == (4, 50, codebook.latent_dim) and not latents.requires_grad
    assert (codebook.quantize(latents.flatten(0, 1)) == k.flatten(0, 1)).all()
    before = codebook.representative_latents(k)
    optimizer = th.optim.Adam(codebook.parameters(), lr=2.0)
    codebook(k).square().sum().backward()
    optimizer.step()
    assert (codebook.representative_latents(k).abs() > 1).any()
    codebook.project()
    after = codebook.representative_latents(k)
    assert after.abs().max() <= 1 and (after != before).all()
    assert codebook.quantize(after.flatten(0, 1)).shape == (200, 4)


def test_random_choices_repeat_with_a_generator():
    first, second = (random_values((7, 7), (30,), generator=th.Generator().manual_seed(3)) for _ in range(2))
    assert (first == second).all()


def test_random_values_are_uniform_over_what_masks_allow():
    th.manual_seed(0)
    masks = th.zeros(2, sum(RADICES), dtype=th.bool)
    masks[0, [0, 2, 4, 5, 7, 8, 10]] = True
    masks[1] = True
    k = random_values(RADICES, (2, 3000), masks)
    for row, allowed in enumerate(([{0, 2}, {1}, {0, 2, 3}, {0}], [set(range(n)) for n in RADICES])):
        for choice, values in enumerate(allowed):
            counts = th.bincount(k[row, :, choice], minlength=RADICES[choice])
            assert set(counts.nonzero().flatten().tolist()) == values
            assert (counts[list(values)] - 3000 / len(values)).abs().max() < 4 * 3000**0.5


def test_alternatives_differ_in_one_choice():
    codebook, k = ProductCodebook(RADICES, 3), random_values(RADICES, (30,))
    for repeatable in (False, True):
        others = codebook.alternatives(k, sum(RADICES), repeatable)
        changed = others != k[:, None]
        # Every value of every choice, the present one among them
        assert changed.sum(dim=2).max() == 1 and (changed.sum(dim=1) == th.tensor(RADICES) - 1).all()
        assert all(len({tuple(row) for row in rows}) == 1 + sum(RADICES) - len(RADICES) for rows in others.tolist())
    # Where there are many choices, a few alternatives change the last ones too
    many = ProductCodebook((2,) * 40, 2)
    changed = many.alternatives(th.zeros(1, 40, dtype=th.long), 64, True)[0].sum(dim=0)
    assert changed[:4].any() and changed[-4:].any()
    some, again = (codebook.alternatives(k, 4, True) for _ in range(2))
    assert th.equal(some, again) and (codebook.alternatives(k, 4, False) != codebook.alternatives(k, 4, False)).any()


def test_an_action_is_allowed_if_all_of_its_values_are():
    codebook, k = ProductCodebook(RADICES, 3), random_values(RADICES, (20, 30))
    masks = th.rand(20, sum(RADICES)) < 0.8
    of_choices = masks.split(RADICES, dim=1)
    expected = th.stack([mask.gather(1, k[:, :, i]) for i, mask in enumerate(of_choices)]).all(dim=0)
    assert expected.any() and not expected.all() and th.equal(codebook.allowed(k, masks), expected)


def test_usage_of_every_choice():
    k = th.tensor([[0, 0], [1, 0], [0, 0], [1, 0]])
    usage, perplexity = ProductCodebook((2, 4), 3).usage(k)
    assert usage.tolist() == [1, 0.25] and perplexity.tolist() == pytest.approx([2, 1])
