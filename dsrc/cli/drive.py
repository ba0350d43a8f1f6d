"""Commands `dsrc drive` and `search`: closed-loop episodes, campaigns of them, another look at one, what crashes."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from tyro.conf import arg

from dsrc.cli.progress import log_lines, made, progress
from dsrc.cli.toml_files import require_kind
from dsrc.options.driving import DriveOptions
from dsrc.options.fields import File, Folder, Output
from dsrc.options.search import SearchOptions
from dsrc.runs.executors import Pool


class Drive(DriveOptions, frozen=True, kw_only=True):
    """Drive closed-loop episodes: what an ego makes of what it perceives.

    A campaign drives scenarios x perceptions x corruptions x channels x seeds, resumes when it was interrupted, and
    writes results.csv, tables, plots and a log of every episode. The log of an episode in place of a scenario shows
    the same traffic to another perception. A critical value is where the outcome of one episode flips. Conditions and a
    baseline are for CI: exit with 1 where a condition fails, and where perception or driver failed in every episode.

    Examples:
        dsrc drive lta_truck --perception truth sight ego team --seed 0 1 2
        dsrc drive ima_queue --perception team --out runs/queue --fail-under "crashed<=5%" --junit queue.xml

    Attributes:
        out: folder of results and logs; default: results are printed only.
        reuse: folders of earlier campaigns: their episodes whose settings and detector agree are not driven again, also
            where code and package versions differ, which is recorded; or results.csv, controls.csv or careful.csv of
            earlier runs, of the same code, whose episodes then have no log; default: none.
        docs: Markdown document that gets the tables and plots of a campaign too, files beside it: those that it has
            markers for, or all at its end if it has none; default: none.
        critical: search the severity of the corruption, or the delay or loss of messages, at which the outcome of the
            episode flips; a fault with such a number is varied in their place; default: none.
        fail_under: conditions, [PERCEPTION:] QUANTITY SIGN NUMBER, such as crashed<=5% or "team: pdms>=0.8": exit with
            1 where one fails for a perception. Quantities are shares of episodes (crashed, at_fault, arrived, success,
            stuck, timeout, left, lost, failed), means of the metrics in results.csv, and with a baseline the numbers of
            episodes fixed and broken; default: none.
        baseline: results.csv of an earlier run, or its folder, whose episodes of equal settings and seed are compared
            with these; default: none.
        junit: JUnit's XML, a test case for each condition and episode; with conditions these alone can fail; default:
            none.
        view: show one episode in the browser as it is driven, and go on showing it until interrupted.
        verbose: also say which engine runs the networks, and why.
    """

    out: Folder | None = None
    reuse: tuple[Path, ...] = ()
    docs: File | None = None
    critical: Literal["severity", "delay_s", "loss"] | None = None
    fail_under: tuple[str, ...] = ()
    baseline: Annotated[Path, arg(metavar="RESULTS.csv|FOLDER")] | None = None
    junit: File | None = None
    view: bool = False
    verbose: bool = False
    pool: Pool = Pool()
    output: Output = Output()

    def run(self) -> None:
        """Drive what is missing and print the table."""
        import tempfile

        if self.verbose:
            log_lines("dsrc.models.storage", on_terminals=True)
        require_kind("drive", self.what, "scenario", "campaign")
        self._check_together()
        if self.what.endswith(".npz"):
            self._replay()
            return
        if self.critical is not None:
            self._search()
            return
        if self.view:
            self._watch()
            return
        if self.out is not None:
            self._drive(self.out)
            return
        with tempfile.TemporaryDirectory(prefix="dsrc-drive-") as folder:
            self._drive(Path(folder))

    def _check_together(self) -> None:
        """Raise SettingsError for options that would have no effect beside others."""
        from sensors.corruptions import CLEAN
        from sim.errors import SettingsError, complaint, option

        log = self.what.endswith(".npz")
        asks = {
            "--view shows an episode": self.view,
            f"--critical {self.critical} prints its result": self.critical is not None,
            f"{self.what} is the log of an episode": log,
        }
        asked = next((why for why, given in asks.items() if given), None)
        if asked:
            given = [name for name in ("docs", "reuse", "fail_under", "baseline", "junit") if getattr(self, name)]
            given += ["workers"] if self.pool != Pool() else []
            given += ["out"] if self.critical is not None and self.out is not None else []
            if given:
                raise SettingsError(f"drive: {asked}; leave out {option(given[0])}")
        for name in (one for one in ("docs", "reuse") if getattr(self, one)):
            if self.out is None:
                raise SettingsError(f"drive: {option(name)} goes with a folder of results; add --out")
        if self.docs is not None and not self.what.endswith(".toml"):
            raise SettingsError(complaint("drive", "--docs", "the TOML of a campaign, which has a name", self.what))
        if self.critical is not None and (log or self.view):
            raise SettingsError(f"drive: --critical searches a scenario; leave out {self.what if log else '--view'}")
        if log and self.view:
            raise SettingsError(f"drive: {self.what} is driven already; run: dsrc view {self.what}")
        if log:
            for name in ("seed", "duration_s", "detect_every_s", "latency_s"):
                if getattr(self, name) not in (None, ()):
                    raise SettingsError(f"drive: {self.what} is a log, which has its own; leave out {option(name)}")
        elif not self.what.endswith(".toml") and not set(self.corruption) - {CLEAN}:
            for name in ("corrupted_agents", "severity", "family"):
                if getattr(self, name):
                    raise SettingsError(f"drive: {option(name)} says how sensors are corrupted; add --corruption")

    def _drive(self, out: Path) -> None:
        from rich.console import Console

        from dsrc.closed_loop.campaign.jobs import late_messages
        from dsrc.closed_loop.campaign.read import campaign_of
        from dsrc.closed_loop.campaign.run import (
            engines_there,
            estimate_s,
            read_results,
            reused,
            run_campaign,
            take_episodes,
        )
        from dsrc.closed_loop.causes.episodes import crash_causes
        from dsrc.closed_loop.metrics.detections import calibrations
        from dsrc.closed_loop.perception.open import WITHOUT_SENSOR
        from dsrc.closed_loop.report.baseline import read_baseline
        from dsrc.closed_loop.report.conditions import check_conditions
        from dsrc.closed_loop.report.findings import Findings
        from dsrc.closed_loop.report.gate import Gate, campaign_junit
        from dsrc.closed_loop.report.report import check_publication, publish_report, write_report
        from dsrc.closed_loop.report.terminal import summary_table
        from dsrc.closed_loop.types import FAILED
        from dsrc.runs.lock import locked
        from sim.files import check_output, write_file

        plan, folders = campaign_of(self), [one for one in self.reuse if one.is_dir()]
        baseline = None if self.baseline is None else read_baseline(self.baseline)
        names = [one.name for one in plan.perceptions]
        conditions = check_conditions(self.fail_under, names, baseline is not None)
        if self.junit is not None:
            check_output(self.junit)
        known = read_results(one for one in self.reuse if not one.is_dir())
        if self.out is not None:
            if self.docs is not None:
                check_publication(plan, self.docs)
            with locked(out, what="campaign"):
                pass  # a folder that cannot be written to is told before anything else
            if folders:
                sys.stderr.write(f"{take_episodes(plan, out, folders)} episodes are taken from earlier campaigns\n")
            for engine, count in engines_there(plan, [out, *folders]).items():
                sys.stderr.write(
                    f"{count} episodes there are by engine {engine}, this run's are by {plan.engine}: they are "
                    f"driven anew; --engine {engine} takes them\n"
                )
            if known:
                sys.stderr.write(f"{reused(plan, known)} of {len(known)} results are of this campaign's episodes\n")
            episodes, seconds = estimate_s(plan, out, self.pool, known)
            sys.stderr.write(f"{episodes} episodes to drive, about {_duration(seconds)}\n")
        for name, delay_s, every_s, age_s in late_messages(plan):
            sys.stderr.write(
                f"channel {name}: messages are {delay_s:g} s late and measured every {every_s:g} s, so the newest at a "
                f"detection is {age_s:g} s old\n"
            )
        with progress(f"drive {plan.name}") as report:
            result = run_campaign(plan, out, self.pool, report, known)
        gate = Gate.of(result, conditions, baseline)
        more = Findings(gate)
        if self.out is not None or self.junit is not None:
            with progress("causes of crashes") as report:
                more = Findings(gate, crash_causes(result.plan, result.results, out / "episodes", report))
        if self.out is not None:
            with progress("calibration of detections") as report:
                sure = {one.name for one in plan.perceptions if one.kind in WITHOUT_SENSOR}  # nothing to calibrate
                keys = [one.key for one in result.results if one.perception not in sure]
                more = replace(more, calibrations=calibrations(keys, out / "episodes", report))
        console = Console(highlight=False)
        console.print(summary_table(result), *gate.tables())
        if self.junit is not None:
            write_file(self.junit, campaign_junit(result, gate, more.sentences))
        if self.out is not None:
            with progress("pictures of failures") as report:
                places = list(write_report(result, out, more, report))
            if self.docs is not None:
                places += [publish_report(result, out, self.docs, more), self.docs]
            if any((out / "episodes").glob("*.npz")):
                made(places, "results, tables and logs of episodes", "view", out, new=episodes > 0)
            else:  # all results are of an earlier run
                made(places, "results and tables")
        if failed := [one for one in gate.verdicts if not one.holds]:
            sys.stderr.write(f"{len(failed)} of {len(gate.verdicts)} conditions fail\n")
        if failed or (result.results and all(one.outcome in FAILED for one in result.results)):
            raise SystemExit(1)

    def _watch(self) -> None:
        """Drive one episode before the eyes of a page; its log goes to `out`."""
        from dsrc.closed_loop.campaign.episode import drive_episode
        from dsrc.closed_loop.campaign.jobs import episodes_of
        from dsrc.closed_loop.campaign.read import campaign_of
        from dsrc.closed_loop.loop import ClosedLoop
        from dsrc.review.page.app import LivePage
        from dsrc.review.sources.episodes import EpisodeSource
        from sim.errors import SettingsError

        jobs = episodes_of(campaign_of(self))
        if len(jobs) != 1:
            raise SettingsError(f"drive: --view shows one episode; these options describe {len(jobs)}")
        (job,) = jobs
        source = EpisodeSource(f"{job.scenario}, {job.perception}, seed {job.seed}")

        def put(loop: ClosedLoop) -> None:
            sensed = getattr(loop.perception, "sensed", None)
            now_s = loop.tick.actors.time_s
            if len(source) == 0:
                source.place(loop.scenario, loop.seed)
            source.put(loop.tick, loop.ego_id, sensed if sensed is not None and sensed.time_s == now_s else None)

        with LivePage(source) as page:
            sys.stderr.write(f"{page.url}\n")
            log = drive_episode(job, put)
            source.end(str(log.outcome), log.message)
            sys.stdout.write(f"{log.outcome}{f': {log.message}' if log.message else ''}\n")
            if self.out is not None:
                path = log.save(self.out / "episode.npz")
                made(path, "the log of the episode", "view", path)
            page.wait()

    def _search(self) -> None:
        from rich.console import Console

        from dsrc.closed_loop.campaign.read import campaign_of
        from dsrc.closed_loop.campaign.search import search, search_table, search_text

        assert self.critical is not None
        with progress(f"drive {self.what}") as report:
            found = search(campaign_of(self), self.critical, report)
        Console(highlight=False).print(search_table(found))
        sys.stdout.write(f"{search_text(found)}\n")

    def _replay(self) -> None:
        from rich.console import Console

        from dsrc.closed_loop.campaign.read import campaign_of
        from dsrc.closed_loop.campaign.run import replay_at
        from dsrc.closed_loop.log import EpisodeLog
        from dsrc.closed_loop.report.terminal import comparison_table

        own = EpisodeLog.load(Path(self.what)).settings
        # Options are checked as those of an episode by these eyes.
        eyes, longest_s = self.perception or (own.perception,), own.loop.get("duration_s")
        campaign_of(msgspec.structs.replace(self, what="four_way", perception=eyes, duration_s=longest_s))
        former, again = replay_at(Path(self.what), self)
        Console(highlight=False).print(comparison_table(former, again))
        if self.out is not None:
            path = again.save(self.out / "again.npz")
            made(path, "the log of the second look", "view", path)


class Search(SearchOptions, frozen=True, kw_only=True):
    """Search for the smallest faults and the parameters that crash the ego.

    Each distinct failure has its cause, its log, its smallest fault, and the share of its neighbourhood that crashes
    too. An interrupted search resumes.

    Examples:
        dsrc search lta_truck --fault "brake_gain:0.2..1 from 0..6 s for 0.5..6 s" --out runs/search
        dsrc search lta_truck --perception team --fast team.json --parameter conflict_mps --seed 0 1 2 --out runs/search

    Attributes:
        out: folder of the report, the failures and the logs of all episodes.
    """

    out: Folder
    pool: Pool = Pool()
    output: Output = Output()

    def run(self) -> None:
        """Search, write the report and print its tables."""
        from rich.console import Console

        from dsrc.closed_loop.falsification.report import failure_table, optimizer_table, write_search
        from dsrc.closed_loop.falsification.run import search_failures

        with progress(f"search {' '.join(self.scenario)}") as report:
            found = search_failures(self, self.out, pool=self.pool, progress=report)
        console = Console(highlight=False)
        console.print(optimizer_table(found))
        if found.failures:
            console.print(failure_table(found))
        else:
            sys.stdout.write("no failure found\n")
        places = write_search(found, self.out)
        made(places, "report, failures and logs of episodes", "view", self.out, new=found.made > 0)


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120.0 else f"{seconds / 60.0:.0f} min"
