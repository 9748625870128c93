from __future__ import annotations

from stereotruth.sensor.linked_images import Links, new_links


def test_groups_and_unused_images_are_named() -> None:
    links = Links.of("ABCDEFG", [("C", "B"), ("A", "B"), ("E", "F")])
    assert links.groups == (("A", "B", "C"), ("E", "F")) and links.unused == ("D", "G")
    unused, groups = links.sentences
    assert unused == "2 images in no pair: D, G" and groups.endswith(": A, B, C; E, F")
    assert Links.of("ABC", [("A", "B"), ("C", "A")]).sentences == []


def test_new_links_are_the_first_that_link_anything() -> None:
    pairs = [("A", "B"), ("B", "C"), ("A", "C"), ("C", "D")]
    assert new_links(pairs) == [pairs[0], pairs[1], pairs[3]]
    assert new_links(pairs, [("A", "C")]) == [pairs[0], pairs[3]]
