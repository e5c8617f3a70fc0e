"""The documentation as a site: it builds without a warning, is short, and can be searched."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.docs import count, reference
from tests.docs.browser import browser, served
from tests.docs.documents import ROOT
from tests.needs import needs

MOST_WORDS, MOST_DESIGN_PAGES = 15_000, 25


@pytest.mark.parametrize("page", reference.PAGES)
def test_a_generated_page_is_up_to_date(page):
    """Else run `python -m tests.docs.reference`."""
    text = (reference.FOLDER / page).read_text()
    assert reference.brought_up_to_date(text, reference.PAGES[page]) == text


def test_there_is_not_too_much_to_read():
    """`python -m tests.docs.count` says where the words are."""
    assert sum(count.others().values()) <= MOST_WORDS
    assert len(count.design()) <= MOST_DESIGN_PAGES


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Return the folder of the built site."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


@needs("mkdocs")
def test_the_site_builds_without_a_warning_and_links_lead_somewhere(site):
    """`mkdocs build --strict` fails on links and anchors that lead nowhere, and on lost pages."""
    assert (site / "tutorial/first-pool/index.html").exists()
    assert (site / "search/search_index.json").exists()


@needs("mkdocs", "browser")
def test_a_reader_finds_a_page_by_searching(site, tmp_path):
    """In a real browser: what is typed into the search leads to a page."""
    from selenium.webdriver.common.by import By
    from selenium.webdriver.support.ui import WebDriverWait

    with served(site) as address, browser(tmp_path) as driver:
        driver.get(f"{address}/?q=preemption+notice")
        found = WebDriverWait(driver, 30).until(
            lambda page: page.find_elements(By.CSS_SELECTOR, ".md-search-result__link")
        )
        pages = [link.get_attribute("href").partition("?")[0] for link in found]
        assert f"{address}/how-to/clouds/" in pages
        driver.get(found[0].get_attribute("href"))
        assert "preemption" in driver.find_element(By.TAG_NAME, "article").text
        assert [line for line in driver.get_log("browser") if line["level"] == "SEVERE"] == []
