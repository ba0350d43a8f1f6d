"""Panels of the page: what they show comes as `Shown`, what they change goes to `Page`."""

from dsrc.review.page.controls import Control
from dsrc.review.page.panels.agents import AgentsPanel
from dsrc.review.page.panels.detections import DetectionsPanel
from dsrc.review.page.panels.episode import EpisodePanel
from dsrc.review.page.panels.labs.corruption import CorruptionLabPanel
from dsrc.review.page.panels.labs.sensor import SensorLabPanel
from dsrc.review.page.panels.legend import LegendPanel
from dsrc.review.page.panels.look import LookPanel
from dsrc.review.page.panels.over_time import OverTimePanel
from dsrc.review.page.panels.panel import Panel
from dsrc.review.page.panels.ruler import RulerPanel
from dsrc.review.page.panels.run.errors import ErrorsPanel
from dsrc.review.page.panels.run.gallery import GalleryPanel
from dsrc.review.page.panels.run.notes import NotesPanel
from dsrc.review.page.panels.run.overview import OverviewPanel
from dsrc.review.page.panels.selection import SelectionPanel
from dsrc.review.page.panels.share import SharePanel
from dsrc.review.page.panels.timeline import TimelinePanel

PANELS: tuple[type[Panel], ...] = (
    LegendPanel,
    TimelinePanel,
    EpisodePanel,
    SelectionPanel,
    OverTimePanel,
    SharePanel,
    OverviewPanel,
    NotesPanel,
    DetectionsPanel,
    ErrorsPanel,
    GalleryPanel,
    CorruptionLabPanel,
    SensorLabPanel,
    AgentsPanel,
    LookPanel,
    RulerPanel,
)
"""The legend, and the panels from the top of the page: a cause is read without scrolling at 1280 x 720."""

CONTROLS: tuple[Control, ...] = tuple(
    control
    for panel in sorted(PANELS, key=lambda one: one not in (TimelinePanel, SelectionPanel, CorruptionLabPanel))
    for control in panel.table
)
"""The controls in the order in which a link is read: what the others depend on comes first."""
