"""Losses of detection, and of the three stages of the distillation.

Where the paper and its released code differ, `DistillSettings` has both: its defaults follow the paper, `released()`
is the code. The reconstruction losses stand beside their head, in `dsrc.models.layers.reconstruction`.
"""

from collections.abc import Iterable
from functools import cache
from typing import Annotated, Any, Literal

import msgspec
import torch
from msgspec import Meta
from torch import Tensor
from torch.nn import functional

from dsrc.models.detector import NetworkOutput

_BETA = 1 / 9

Weight = Annotated[float, Meta(ge=0)]

# Legend: N agents of all samples, B samples, H W input grid, h w = H/2 W/2 output grid.


class DistillSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Distillation settings: weights and forms of the losses.

    Attributes:
        dae, daf, dap: weights of the distillation after encoding, fusion and prediction (alpha, beta, gamma).
        fade: last share of the steps, over which these weights fall linearly to 0, so that the training ends with
            detection alone.
        form: `paper`: binary masks. Squared feature differences are taken over the foreground, relative to the
            teacher's mean square there, and averaged over the scales: the sums of Equations 2 and 3 grow with the
            grid, the agents and the features, and would outweigh the detection loss tenfold. Prediction by the
            Kullback-Leibler divergence of each foreground anchor's own probability and, for the box residuals of
            positive anchors, of unit normals around both predictions (half the mean squared difference), both per
            number of positives, as the detection loss: means over the foreground would be 2 % of it.
            Equation 3 has no mask; `daf_mask` decides.
            `released`: bilinear soft masks, means over all elements including the masked zeros, and softmaxes over
            the two anchors and over the 14 residuals.
        daf_mask: restrict the distillation after fusion to the foreground of any agent. On by default: over the whole
            map, of which a few per cent are foreground, the mean is a distillation of the road.
        teacher_norms: batch norms of the teacher while its student is trained: `fixed`, or `moving` as in the released
            code: they use and average the batch's statistics, and those of the pillar encoder, then and when the
            teacher is trained, include the objects' clouds.
    """

    dae: Weight = 1.0
    daf: Weight = 1.0
    dap: Weight = 0.5
    fade: Annotated[float, Meta(ge=0, le=1)] = 0.0
    form: Literal["paper", "released"] = "paper"
    daf_mask: bool = True
    teacher_norms: Literal["fixed", "moving"] = "fixed"


def released() -> DistillSettings:
    """Return the settings of the released code: all weights 1, its masks, its means and its teacher's norms."""
    return DistillSettings(dap=1.0, form="released", teacher_norms="moving")


def detection_loss(cls: Tensor, reg: Tensor, positive: Tensor, regression: Tensor) -> tuple[Tensor, Tensor]:
    """Return the classification and the box loss, each a mean over samples.

    Sigmoid focal loss (alpha 0.25, gamma 2; every anchor that is not positive is negative) and twice the smooth L1
    (beta 1/9) of the residuals of positive anchors, the angle through sin(a - b); both per number of positives.

    Args:
        cls: (B, 2, h, w) logits.
        reg: (B, 14, h, w) residuals.
        positive: (B, h, w, 2) bool.
        regression: (B, h, w, 14) residuals of the assigned boxes.
    """
    target = positive.permute(0, 3, 1, 2).to(cls.dtype)
    count = target.sum((1, 2, 3), keepdim=True).clamp_(min=1)
    return _FocalLoss.apply(cls, target, count), _BoxLoss.apply(reg, positive, regression, count)


class _FocalLoss(torch.autograd.Function):
    """Sigmoid focal loss of (B, 2, h, w) logits, with its gradient."""

    @staticmethod
    def forward(ctx: Any, logits: Tensor, target: Tensor, count: Tensor) -> Tensor:
        probability = torch.sigmoid(logits)
        # Of a positive anchor p - 1 and 0.25, of a negative one p and 0.75.
        miss = probability - target
        weight = (target * -0.5).add_(0.75).div_(count * len(logits))
        entropy = functional.binary_cross_entropy_with_logits(logits, target, reduction="none")
        ctx.save_for_backward(probability, miss, weight, entropy)
        return miss.square().mul_(entropy).mul_(weight).sum()

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        probability, miss, weight, entropy = ctx.saved_tensors
        slope = (1 - probability).mul_(probability).mul_(2 * entropy)
        return (miss.square().add_(slope)).mul_(miss).mul_(weight).mul_(gradients[0]), None, None


class _BoxLoss(torch.autograd.Function):
    """Twice the smooth L1 (beta 1/9) of the residuals of positive anchors, with its gradient.

    Of all anchors, most of which count nothing: a choice of the positive ones would make the host wait for the device.
    """

    @staticmethod
    def forward(ctx: Any, reg: Tensor, positive: Tensor, regression: Tensor, count: Tensor) -> Tensor:
        turn = reg.permute(0, 2, 3, 1) - regression
        error = torch.where(_angles(reg.device), turn.sin(), turn)
        smooth = functional.huber_loss(error, torch.zeros_like(error), reduction="none", delta=_BETA)
        weight = (positive / count)[..., None]
        ctx.save_for_backward(turn, error, weight)
        return smooth.unflatten(-1, (2, 7)).mul_(weight).sum().mul_(2 / _BETA / len(reg))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None, None]:
        turn, error, weight = ctx.saved_tensors
        slope = torch.where(_angles(turn.device), turn.cos(), 1.0).mul_(error.clamp(-_BETA, _BETA))
        slope = slope.unflatten(-1, (2, 7)).mul_(weight * (gradients[0] * (2 / _BETA / len(turn)))).flatten(-2)
        return slope.permute(0, 3, 1, 2), None, None, None


@cache
def _angles(device: torch.device) -> Tensor:
    """Return the (14,) mask of the angles among the residuals of two anchors."""
    return torch.arange(14, device=device) % 7 == 6


def direction_loss(direction: Tensor, positive: Tensor, regression: Tensor) -> Tensor:
    """Return the cross entropy of the positive anchors' directions, per number of positives, a mean over samples.

    Args:
        direction: (B, 2, h, w) logits of a box that heads against its anchor.
        positive: (B, h, w, 2) bool.
        regression: (B, h, w, 14) residuals of the assigned boxes.
    """
    logits = direction.permute(0, 2, 3, 1)
    against = (torch.cos(regression[..., 6::7]) < 0).to(logits.dtype)
    entropy = functional.binary_cross_entropy_with_logits(logits, against, reduction="none")
    return ((entropy * positive).flatten(1).sum(1) / positive.flatten(1).sum(1).clamp(min=1)).mean()


def consistency_loss(view: NetworkOutput, clean: NetworkOutput, positive: Tensor) -> Tensor:
    """Return the consistency loss of predictions in a corrupted view with those in the clean one, without its gradient.

    The Kullback-Leibler divergence of every anchor's probability, and of unit normals around the residuals of positive
    anchors; per number of positives, a mean over samples. Empty cells count: corruption causes false positives there.

    Args:
        view: output in the corrupted view, with gradient.
        positive: (B, h, w, 2) bool.
    """
    return _prediction_error(view, clean, positive, torch.ones_like(view.cls[:, :1]))


def _prediction_error(student: NetworkOutput, teacher: NetworkOutput, positive: Tensor, where: Tensor) -> Tensor:
    """Return the error of predictions to a teacher's, per number of positives, a mean over samples.

    Args:
        positive: (B, h, w, 2) bool anchors whose residuals are compared.
        where: (B, 1, h, w) mask of the cells whose probabilities are compared.
    """
    return _PredictionError.apply(student.cls, student.reg, teacher.cls, teacher.reg, positive, where)


class _PredictionError(torch.autograd.Function):
    """`_prediction_error` with its gradient."""

    @staticmethod
    def forward(
        ctx: Any, cls: Tensor, reg: Tensor, taught_cls: Tensor, taught_reg: Tensor, positive: Tensor, where: Tensor
    ) -> Tensor:
        count = positive.sum((1, 2, 3), keepdim=True).clamp_(min=1)
        cells = where / count
        # Kullback-Leibler divergence of the student's from the teacher's logits: the cross entropy less the teacher's.
        probability = torch.sigmoid(taught_cls)
        divergence = functional.binary_cross_entropy_with_logits(cls, probability, reduction="none")
        divergence -= functional.binary_cross_entropy_with_logits(taught_cls, probability, reduction="none")
        error = (reg - taught_reg).unflatten(1, (2, 7))
        anchors = (positive / count).permute(0, 3, 1, 2).unsqueeze(2)
        residuals = error.square().mul_(anchors).sum()
        ctx.save_for_backward(cls, probability, cells, error, anchors)
        return divergence.mul_(cells).sum().add_(residuals, alpha=0.5 / 7).div_(len(cls))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        cls, probability, cells, error, anchors = ctx.saved_tensors
        share = gradients[0] / len(cls)
        of_cls = torch.sigmoid(cls).sub_(probability).mul_(cells).mul_(share)
        of_reg = (error * anchors).mul_(share / 7).flatten(1, 2)
        return of_cls, of_reg, None, None, None, None


def distillation_losses(
    student: NetworkOutput,
    teacher: NetworkOutput,
    foreground: Tensor,
    positive: Tensor,
    agents: tuple[int, ...],
    settings: DistillSettings,
) -> dict[str, Tensor]:
    """Return the weighted losses `dae`, `daf` and `dap`.

    Args:
        student: its output, with gradient.
        teacher: its output on the teacher's clouds.
        foreground: (N, H, W) bool cells with a point on one of the agent's objects.
        positive: (B, h, w, 2) bool positive anchors.
        agents: number of agents of each row of the fused maps.
    """
    if settings.form == "released":
        return _released_losses(student, teacher, foreground, agents, settings)
    masks = [functional.max_pool2d(foreground[:, None].float(), 2)]
    masks += [functional.max_pool2d(masks[0], 2), functional.max_pool2d(masks[0], 4)]
    union = torch.stack([group.amax(0) for group in masks[0].split(list(agents))])
    masks.append(union if settings.daf_mask else torch.ones_like(union))
    maps = (*student.stages, student.fused), (*teacher.stages, teacher.fused)
    first, second, third, daf = _relative_errors(*maps, masks)
    dae = (first + second + third) / 3
    dap = _prediction_error(student, teacher, positive, union)
    return {"dae": weighted(dae, settings.dae), "daf": weighted(daf, settings.daf), "dap": weighted(dap, settings.dap)}


def total(losses: Iterable[Tensor]) -> Tensor:
    """Return the sum of losses."""
    return _Total.apply(*losses)


class _Total(torch.autograd.Function):
    """`total` with its gradient."""

    @staticmethod
    def forward(ctx: Any, *losses: Tensor) -> Tensor:
        return torch.stack(losses).sum()

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, ...]:
        return gradients * len(ctx.needs_input_grad)


def weighted(loss: Tensor, weight: float) -> Tensor:
    """Return a loss times its weight; of a weight of 1 itself."""
    return loss if weight == 1.0 else weight * loss


def _relative_errors(
    students: tuple[Tensor, ...], teachers: tuple[Tensor, ...], masks: list[Tensor]
) -> tuple[Tensor, ...]:
    """Return the squared differences of (N, C, h, w) maps in (N, 1, h, w) masks, relative to the teachers' squares.

    Both are means over the mask, or 0 of an empty one.
    """
    return _RelativeErrors.apply(teachers, masks, *students)


class _RelativeErrors(torch.autograd.Function):
    """`_relative_errors` with their gradients, one map each that both passes share."""

    @staticmethod
    def forward(ctx: Any, teachers: tuple[Tensor, ...], masks: list[Tensor], *students: Tensor) -> tuple[Tensor, ...]:
        # The masks' type is the larger one: differences of maps in half precision are not.
        errors, seen = torch._foreach_mul(students, masks), torch._foreach_mul(teachers, masks)
        torch._foreach_sub_(errors, seen)
        found = [square.sum() for square in torch._foreach_mul(errors, errors)]
        torch._foreach_mul_(seen, seen)
        # A millionth is added to the teacher's mean square; the clamp is of an empty mask.
        wholes, counts = [square.sum() for square in seen], [mask.sum() for mask in masks]
        torch._foreach_mul_(counts, [1e-6 * student.shape[1] for student in students])
        torch._foreach_add_(wholes, counts)
        torch._foreach_clamp_min_(wholes, 1e-6)
        torch._foreach_div_(found, wholes)
        ctx.save_for_backward(*errors, *wholes)
        return tuple(found)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        errors, wholes = ctx.saved_tensors[: len(gradients)], ctx.saved_tensors[len(gradients) :]
        slopes = torch._foreach_div(gradients, wholes)
        torch._foreach_mul_(slopes, 2)
        return None, None, *torch._foreach_mul(errors, slopes)


def _released_losses(
    student: NetworkOutput,
    teacher: NetworkOutput,
    foreground: Tensor,
    agents: tuple[int, ...],
    settings: DistillSettings,
) -> dict[str, Tensor]:
    dae = student.cls.new_zeros(())
    for s, t in zip(student.stages, teacher.stages, strict=True):
        soft = functional.interpolate(foreground[:, None].float(), s.shape[-2:], mode="bilinear", align_corners=False)
        dae = dae + functional.mse_loss(soft * s, soft * t)
    size = student.fused.shape[-2:]
    soft = functional.interpolate(foreground[:, None].float(), size, mode="bilinear", align_corners=False)
    union = torch.stack([group.sum(0) for group in soft.split(list(agents))]) != 0
    daf = functional.mse_loss(union * student.fused.float(), union * teacher.fused.float())
    dap = student.cls.new_zeros(())
    for s, t in ((student.cls, teacher.cls), (student.reg, teacher.reg)):
        log_s, log_t = torch.log_softmax(s, dim=1), torch.log_softmax(t, dim=1)
        dap = dap + functional.kl_div(log_s, log_t, reduction="none", log_target=True).mean()
    return {"dae": settings.dae * dae, "daf": settings.daf * daf, "dap": settings.dap * dap}
