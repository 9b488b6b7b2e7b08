"""The pictures of the station's page are those of the page as it is."""

from docs.pictures.station_hash import HASH, page_hash


def test_the_pictures_of_the_page_are_as_new_as_the_page():
    """A picture of an older page promises what is no longer there."""
    assert HASH.read_text(encoding="utf-8").strip() == page_hash(), (
        "monstertruckd/station/page has changed since its pictures were taken: run `python -m docs.pictures.station` "
        "(needs chromium, takes a minute), look at docs/pictures/station-*.png, and commit them with station.sha256"
    )
