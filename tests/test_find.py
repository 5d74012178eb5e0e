"""Lenses by words: what photographers type, and the lens that they expect; of a library of any size, in time."""

import json
import re
import shutil
import subprocess
import time
from pathlib import Path

import pytest
from command_line import failure, run_json

import neurolens as nl
from neurolens.base.errors import InputError, Note
from neurolens.base.find import entries, find, nicknames, said_of, words_of
from neurolens.base.lensname import resolve
from neurolens.cli import main

LENSES = Path(__file__).parents[1] / "lenses"


@pytest.mark.parametrize(
    ("query", "first"),
    [
        ("canon rf", "canon_rf_"),
        ("Canon RF 50mm F1.2", "canon_rf_50mm_f1_2_l_usm"),
        ("rf50 1.2", "canon_rf_50mm_f1_2_l_usm"),
        ("summilux", "leica_summilux_50mm_f1_4"),
        ("leica 35 lux", "leica_summilux_"),
        ("nikkor 50 1.2", "nikon_nikkor_50mm_f1_2"),
        ("nikkor z 50 1.2", "nikon_nikkor_z_50mm_f1_2_s"),
        ("NOCT", "nikon_nikkor_z_58mm_f0_95_s_noct"),
        ("noct 0,95", "nikon_nikkor_z_58mm_f0_95_s_noct"),
        ("helios 44", "merte_biotar_100"),
        ("Helios 44-2", "merte_biotar_100"),
        ("biotar swirl", "merte_biotar_100"),
        ("petzval", "petzval_portrait_100"),
        ("trioplan soap bubble", "cooke_triplet_50"),
        ("nifty fifty", "canon_ef_50mm_f1_8"),
        ("canon 50/1.8", "canon_ef_50mm_f1_8"),
        ("1,8/50 canon", "canon_ef_50mm_f1_8"),
        ("canon ef 35 f/2", "canon_ef_35mm_f2"),
        ("shorty forty", "canon_ef_40mm_f2_8_stm"),
        ("fuji 56mm", "fujifilm_fujinon_xf_56mm_f1_2_r"),
        ("voigtländer 35 1.2", "voigtlander_nokton_"),
        ("voigtlaender nokton", "voigtlander_nokton_"),
        ("Angénieux 28", "angenieux_28mm_f3_5_r11"),
        ("görlitz orestor", "meyer_optik_gorlitz_135mm_f2_8_orestor"),
        ("leitz summicron 50", "leica_summicron_"),
        ("sony 55 1.8", "sony_sonnar_55"),
        ("master prime", "zeiss_arri_master_prime_t1_3_100mm"),
        ("arri T1.3", "zeiss_arri_master_prime_t1_3_100mm"),
        ("canon ef 70-200", "canon_ef_70_200mm_"),
        ("mft 25", "panasonic_"),
        ("canon zoom 16-35 2.8 iii", "canon_ef_16_35mm_f2_8l_iii_usm"),
        ("olympus 45", "olympus_m_zuiko_ed_45mm_f1_2_pro"),
        ("minolta smooth trans focus", "minolta_135mm_f2_8_t4_5_stf"),
        ("fish eye nikkor", "nikon_fisheye_nikkor_6mm_f2_8"),
        ("serenar 1950s", "canon_serenar_"),
        ("1840", "petzval_portrait_100"),
        ("tilt-shift 24", "nikon_pc_e_nikkor_24mm_f3_5d_ed"),
        ("nikkor macro 200mm", "nikon_af_micro_nikkor_200mm_f4d_if_ed"),
        ("swirl", "petzval_portrait_100"),
        ("swirly lens", "petzval_portrait_100"),
        ("85mm soft", "pentax_smc_f_85mm_f2_8_soft"),
        ("canon 50 bubbles", "canon_50mm_f1_2"),
        ("laikin double gauss 50", "laikin_double_gauss_50"),
    ],
)
def test_words_find_what_a_photographer_expects(query: str, first: str) -> None:
    found = find(query)
    assert found.hits[0].lens.startswith(first)
    assert find(query.upper()).hits[0] == found.hits[0]
    if found.chosen:
        assert found.chosen == found.hits[0]


@pytest.mark.parametrize("rest", ["85", "85mm", "85/1.4", "T* 85mm f/1.4"])
def test_a_lens_that_is_not_there_gives_the_nearest(rest: str) -> None:
    """Until the library has an 85 mm Planar, of which there are several."""
    found = find(f"zeiss planar {rest}")
    if not found.hits:
        assert 1 <= len(found.near) <= 3 and found.near[0].lens.startswith("zeiss_planar")
    assert not find("sumilux 35").hits and "summilux" in find("sumilux 35").near[0].lens
    assert not find("noctilux").hits  # begins as the Noct, another maker's lens


NOTHING = ["", " ", "?!", "lens", "xyzzy qwrtz", "\0", "\ud800", "鏡頭", "9" * 400, "f/", "-"]


@pytest.mark.parametrize("nothing", NOTHING)
def test_what_names_nothing_finds_nothing(nothing: str) -> None:
    found = find(nothing)
    assert (list(found.hits), found.chosen, list(found.near)) == ([], None, [])


@pytest.mark.parametrize(
    "code", ["@SUM(1)", "=x", "a; b", '"50/1.2"', "f/1.4!", "$noct", "noct|biotar", "helios <44>", "%noct", "noct\0"]
)
def test_signs_that_no_name_has_find_nothing_but_the_nearest(code: str) -> None:
    """The same words without these signs find lenses, or are near some."""
    bare, found = find(re.sub(r"[^\w\s/.]", " ", code)), find(code)
    assert (list(found.hits), found.chosen) == ([], None)
    assert len(found.near) == 3 or not bare.hits


@pytest.mark.parametrize("said", ["(noct)", "Noct, 58mm", "[noct]", "NOCT: 58mm", "noct's 58mm"])
def test_signs_that_names_have_do_no_harm(said: str) -> None:
    found = find(said)
    assert (found.hits or found.near)[0].lens == "nikon_nikkor_z_58mm_f0_95_s_noct"


def test_a_text_is_read_as_it_is_engraved() -> None:
    assert words_of("AF-S Zoom-Nikkor 80–200mm 1:2.8 D") == ["af", "s", "zoom", "nikkor", "80-200mm", "f/2.8", "d"]
    assert words_of("NIKKOR-S Auto 5,8cm F1.4") == ["nikkor", "s", "auto", "58mm", "f/1.4"]
    assert words_of("canon_ef_50mm_f1_8") == words_of("Canon EF 50mm f/1.8")
    assert words_of("smc Pentax-F 85mm f/2.8 Soft")[:4] == ["smc", "pentax", "f", "85mm"]


@pytest.mark.parametrize(
    ("word", "stated"),
    [
        ("tilt", "most_tilt_deg ="),
        ("shift", "most_shift_mm ="),
        ("anamorphic", "cylinder"),
        ("micro four thirds", 'mount = "Micro Four Thirds'),
        ("canon ef", 'mount = "Sigma SA, Canon EF'),
    ],
)
def test_a_kind_or_mount_finds_every_lens_whose_file_states_it(word: str, stated: str) -> None:
    files = {file.stem for file in LENSES.glob("*.toml") if stated in file.read_text(encoding="utf-8")}
    assert files and files <= {entry.lens for entry in find(word).hits}


def test_every_whole_name_of_the_library_chooses_its_lens() -> None:
    """But for designs that are named alike."""
    alike = [entry.own for entry in entries()]
    for entry in entries()[::4]:
        chosen = find(entry.name).chosen
        if alike.count(entry.own) == 1:
            assert chosen is not None and chosen.lens == entry.lens, entry.name


def test_nicknames_lead_to_lenses_and_lenses_know_their_nicknames() -> None:
    assert all({"said", "means"} <= row.keys() <= {"said", "means", "about"} for row in nicknames())
    said = [name for row in nicknames() for name in row["said"]]
    assert len({" ".join(words_of(name)) for name in said}) == len(said)
    (biotar,) = find("merte biotar").hits
    assert "helios 44" in said_of(biotar)
    assert "the Helios 44 is a Soviet copy" in find("helios 44").notes[0]


# As an argument


def test_words_of_one_lens_name_it_and_say_so(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.warns(Note, match="'Helios 44' is Biotar 100 mm f/1.4, merte_biotar_100; the Helios 44 is"):
        assert nl.lens("Helios 44").focal_length_mm == pytest.approx(100, abs=0.2)
    with pytest.warns(Note):
        assert resolve("thin:nikkor z 58") == ("thin:", LENSES / "nikon_nikkor_z_58mm_f0_95_s_noct.toml")
    assert main(["lens", "cooke triplet f/5", "--json"]) == 0
    said = capsys.readouterr()
    assert json.loads(said.out)["name"] == "Cooke triplet 50 mm f/5"
    [told] = [line for line in said.err.splitlines() if "compiled" not in line]  # which tests before this one may have
    assert told.startswith("neurolens: 'cooke triplet f/5' is Cooke triplet 50 mm")
    assert main(["lens", "cooke triplet f/5", "--json", "--quiet"]) == 0
    assert capsys.readouterr().err == ""


def test_words_of_several_or_of_none_are_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    said = failure(capsys, "lens", "summilux")
    assert "lenses), expected words of one lens: leica_summilux_50mm_f1_4 (Leica Summilux 50mm f/1.4), " in said
    assert said.count("leica_") == 5
    assert "did you mean 'leica_summilux_" in failure(capsys, "lens", "sumilux 35mm")
    assert "did you mean" not in failure(capsys, "lens", "xyzzy")


def test_files_and_paths_come_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(LENSES / "cooke_triplet_50.toml", "petzval")
    assert resolve("petzval").file == Path("petzval")
    code = "@SUM(1)", "=petzval", "petzval; biotar", "$(biotar)"
    for path in ("lenses/petzval", "./biotar", "../petzval", "petzval.zmx", "biotar\\x", "laikin.ols-99", *code):
        with pytest.raises(InputError, match="missing"):
            resolve(path)


# The command


def test_the_command_lists_lenses_and_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    data = run_json(capsys, "find", "nikkor", "50", "1.2")
    lenses = [row["lens"] for row in data["lenses"]]
    assert lenses[0] == "nikon_nikkor_50mm_f1_2" and {"nikon_ai_s_nikkor_50mm_f1_2", "nikon_nikkor_z_50mm_f1_2_s"} < {
        *lenses
    }
    assert (data["found"], data["chosen"]) == (len(lenses), None)
    for row in data["lenses"]:
        if row["thumbnail"] is None:  # until `experiments lens-index` has drawn it
            continue
        assert Path(row["file"]).is_file() and Path(row["thumbnail"]).read_text().startswith("<svg")
    answer = nl.find("sumilux")
    assert answer.code == 1 and answer["found"] == 0 and len(answer["lenses"]) == 3
    assert "no lens has all these words; the nearest:" in answer.text
    assert nl.find("?").text == "no lens has words like these"
    assert "photographs" in nl.find("canon ef 20mm").text and "no photographs" in nl.find("noct").text
    assert len(nl.find("swirl")["lenses"]) == len(list(LENSES.glob("*.toml")))
    assert len(nl.find("swirl").text.splitlines()) == 12


def test_six_hundred_lenses_take_no_time() -> None:
    assert len(find("summilux 50mm").hits) > 1  # which reads the index once
    began = time.process_time()
    assert find("summilux 35mm").hits
    assert time.process_time() - began < 0.3
    began = time.process_time()
    assert find("sumilux 50mm").near
    assert time.process_time() - began < 0.5


@pytest.mark.skipif(shutil.which("node") is None, reason="needs node, which runs the page's script")
def test_the_search_of_the_index_page_finds_the_same(tmp_path: Path) -> None:
    from experiments.data.library_pages import words_of_row

    queries = ["nikkor 50 1.2", "helios 44", "Angénieux", "F1.2 50mm", "canon rf", "70-200mm", "summilux 35", "1950s"]
    rows = [{"lens": entry.lens, "words": words_of_row({"lens": entry.lens})} for entry in entries()]
    script = LENSES.parent / "neurolens" / "templates" / "table.js"
    (tmp_path / "page.js").write_text(f"""
      const input = {{addEventListener() {{}}}}, kind = {{checked: true, value: 'all', addEventListener() {{}}}};
      const rows = {json.dumps(rows)}.map(r => ({{textContent: '', dataset: {{kinds: 'all', words: r.words}}, r}}));
      const table = {{tBodies: [{{rows}}], tHead: {{rows: [{{cells: []}}]}}}}, found = {{}};
      globalThis.document = {{
        querySelector: () => table, querySelectorAll: () => [kind],
        getElementById: id => id === 'words' ? input : {{}},
      }};
      for (const query of {json.dumps(queries)}) {{
        input.value = query;
        eval({json.dumps(script.read_text())});
        found[query] = rows.filter(r => !r.hidden).map(r => r.r.lens);
      }}
      console.log(JSON.stringify(found));""")
    out = subprocess.run(["node", str(tmp_path / "page.js")], capture_output=True, text=True, check=True).stdout
    assert {q: sorted(names) for q, names in json.loads(out).items()} == {
        query: sorted(entry.lens for entry in find(query).hits) for query in queries
    }
