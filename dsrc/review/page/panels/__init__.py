"""Panels of the page: what they show comes as `Shown`, what they change goes to `Page`."""

from collections.abc import Callable

from dsrc.review.page.panels.corruption_lab import CorruptionLabPanel
from dsrc.review.page.panels.drawn import (
    AgentsPanel,
    DetectionsPanel,
    LegendPanel,
    LookPanel,
    SelectionPanel,
    TimelinePanel,
)
from dsrc.review.page.panels.episode import EpisodePanel
from dsrc.review.page.panels.errors import ErrorsPanel
from dsrc.review.page.panels.gallery import GalleryPanel
from dsrc.review.page.panels.notes import NotesPanel
from dsrc.review.page.panels.over_time import OverTimePanel
from dsrc.review.page.panels.overview import OverviewPanel
from dsrc.review.page.panels.ruler import RulerPanel
from dsrc.review.page.panels.sensor_lab import SensorLabPanel
from dsrc.review.page.panels.share import SharePanel
from dsrc.review.page.protocol import Page, Panel

PANELS: tuple[Callable[[Page], Panel], ...] = (
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
