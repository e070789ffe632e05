"""The comparison of variants. Detects an answer or a number under another variant's name, and a
table too wide to be read."""

import re

from lidar_mi.assessment.report.comparison import page


def a_page(count):
    names = [f"v{k}" for k in range(count)]
    metrics = {
        name: {"backscatter.mc_relative_error": 0.01 * (k + 1), "doppler.photons": 1e5 + k}
        for k, name in enumerate(names)
    }
    settings = {name: {"seed": k} for k, name in enumerate(names)}
    return page("x", settings, metrics, [], {name: [f"answer of {name}"] for name in names})


def rows(html):
    found = re.findall(r"<tr>(.*?)</tr>", html, re.DOTALL)
    return [re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row) for row in found]


def test_answers_come_first_each_under_its_variant():
    html = a_page(3)
    places = [html.index(text) for text in ('">v0</a></h2>', "answer of v0", '">v1</a></h2>')]
    assert places == sorted(places) and max(places) < html.index("<table")


def test_few_variants_are_columns_and_many_are_rows():
    noise = "Monte Carlo noise of a pixel over its signal, median"
    assert [noise, "%", "1", "2", "3"] in rows(a_page(3))
    turned = rows(a_page(6))
    assert ["", f"{noise}, %", "Doppler lidar: photons of a pulse"] in turned
    assert ["v4", "5", "100000"] in turned and all(len(row) <= 6 for row in turned)
