"""Pictures of single frames: evidence in feature maps, the paper's Figure 6, and detections, its Figure 8."""

from dsrc.evaluation.report.pictures.sections import check_pictures, write_pictures

__all__ = ["check_pictures", "write_pictures"]
