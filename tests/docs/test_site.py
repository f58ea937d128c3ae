import json

import pytest

from tests.docs.site import LOOKED_FOR, problems


@pytest.fixture
def site(tmp_path):
    (tmp_path / "search").mkdir()
    index = {"docs": [{"title": "All", "text": " ".join(LOOKED_FOR)}]}
    (tmp_path / "search" / "search_index.json").write_text(json.dumps(index))
    (tmp_path / "404.html").write_text('<a href="/page/#here">to the page</a>')
    (tmp_path / "page").mkdir()
    (tmp_path / "page" / "index.html").write_text(
        '<h1 id="here">Here</h1><a href="../404.html">lost</a><a href="#here">x</a>'
    )
    return tmp_path


def test_a_sound_site(site):
    assert problems(site) == []


def test_what_is_wrong_is_named(site):
    (site / "page" / "index.html").write_text(
        '<a href="../gone/">x</a><img src="https://example.org/a.png"><a href="#no">x</a>'
    )
    index = json.loads((site / "search" / "search_index.json").read_text())
    index["docs"][0]["text"] = index["docs"][0]["text"].replace("fisheye", "")
    (site / "search" / "search_index.json").write_text(json.dumps(index))
    assert set(problems(site)) == {
        "404.html leads to /page/#here: no such place on that page",
        "page/index.html loads https://example.org/a.png from another host",
        "page/index.html leads to #no: no such place on that page",
        "page/index.html leads to ../gone/, which is not there",
        "nobody who looks for 'fisheye' finds anything",
    }
