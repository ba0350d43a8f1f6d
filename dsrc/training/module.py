"""Lightning module of a training: step, validation and alarms."""

import math
from collections.abc import Callable
from itertools import zip_longest
from typing import Any, Self

import lightning.pytorch as pl
import torch
from torch import Tensor, distributed, nn
from torch.optim.lr_scheduler import LambdaLR

from dsrc.evaluation.metrics.ap import FrameResult
from dsrc.models.detector import Detector, NetworkOutput
from dsrc.models.fusion import AgentLayout
from dsrc.models.inputs.batch import Batch
from dsrc.models.layers.encoder import Pillars
from dsrc.models.layers.half_weights import HalfWeights
from dsrc.models.layers.reconstruction import Reconstruction, reconstruction_losses
from dsrc.models.storage.deploy import deployed
from dsrc.training.losses import consistency_loss, detection_loss, direction_loss, distillation_losses, total, weighted
from dsrc.training.recipes import Recipe
from dsrc.training.validation import detections_of, frames_named, metrics_of, prefixed
from sim.errors import UserError

_CHECKED_STEPS = 16
"""Steps after which the losses are looked at."""


class TrainingAlarm(UserError):
    """Failure of a training that more epochs cannot repair."""


class DetectionModule(pl.LightningModule):
    """Training of a teacher, a plain student, or a student with distillation and reconstruction."""

    def __init__(
        self,
        recipe: Recipe,
        detector: Detector,
        teacher: Detector | None = None,
        seed: int = 0,
        *,
        validates_on_unseen: bool = True,
    ) -> None:
        """Set up the networks.

        Args:
            detector: trained network; its settings choose the losses.
            teacher: frozen teacher of a detector that distils.
            seed: seed of draws within the network: dropout, and the cells that Where2comm sends.
            validates_on_unseen: validation frames are not trained on; else their metrics are called `train/...`.
        """
        super().__init__()
        self.recipe, self.detector, self.seed, self.unseen = recipe, detector, seed, validates_on_unseen
        settings = detector.settings
        self.reconstruction = Reconstruction(settings) if settings.rec and settings.role == "student" else None
        # In a tuple the teacher is not a submodule: it is neither saved with the student nor trained.
        self._teacher: tuple[Detector, ...] = () if teacher is None else (teacher.eval().requires_grad_(False),)
        if teacher is not None and recipe.distill.teacher_norms == "moving":
            teacher.train()
        self._deployed: tuple[Detector, ...] = ()
        self._half: dict[nn.Module, HalfWeights] = {}
        self._unchecked: list[tuple[tuple[str, ...], Tensor, str]] = []
        self._results: list[list[FrameResult]] = []
        self._zeros_in_a_row = 0

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Move the weights, the teacher's too: PyTorch moves only submodules."""
        for teacher in self._teacher:
            teacher._apply(fn, recurse)
        super()._apply(fn, recurse)
        self._deployed = ()
        self._half = {}
        return self

    def _taught(self, batch: Batch) -> NetworkOutput:
        """Run the teacher; one whose norms stay has them folded into its convolutions."""
        if self._teacher[0].training:
            network = self._teacher[0]
        else:
            if not self._deployed:
                precision = torch.bfloat16 if self.recipe.bfloat16 else torch.float32
                self._deployed = (deployed(self._teacher[0], precision),)
            network = self._deployed[0]
        with torch.no_grad(), self._autocast():
            return as_teacher(network, batch).float()

    def forward(self, batch: Batch) -> NetworkOutput:
        """Run the network on its clouds: a teacher's own, or the sensors'."""
        with self._autocast():
            if self.detector.settings.role == "teacher":
                return as_teacher(self.detector, batch).float()
            if batch.student is None:
                raise ValueError("the batch was collated for another network")
            return self._student(batch.student, batch.layout)

    def _student(self, pillars: Pillars, layout: AgentLayout) -> NetworkOutput:
        """Run the detector on its clouds."""
        return self._in_type(self.detector)(pillars, layout).float()

    def _in_type(self, network: nn.Module) -> Callable[..., Any]:
        """Return a network, in training with the weights of its convolutions in the recipe's type."""
        if not (self.recipe.bfloat16 and network.training):
            return network
        if network not in self._half:
            self._half[network] = HalfWeights(network, flat=network is self.detector)
        return self._half[network]

    def _autocast(self) -> torch.autocast:
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self.recipe.bfloat16)

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Return the weighted losses of a training batch by name; training minimises their sum."""
        output = self(batch)
        if batch.targets is None:
            raise ValueError("the batch was collated without targets")
        positive = batch.targets.positive
        cls, reg = detection_loss(output.cls, output.reg, positive, batch.targets.regression)
        losses = {"cls": cls, "reg": reg}
        if output.direction is not None:
            turned = direction_loss(output.direction, positive, batch.targets.regression)
            losses["direction"] = self.recipe.direction * turned
        if self.recipe.consistency and batch.student is not None:
            losses["consistency"] = self.recipe.consistency * self._consistency(batch, output)
        if self._teacher and batch.teacher is not None and batch.foreground is not None:
            parts = output, self._taught(batch), batch.foreground, positive, batch.agents
            distilled = distillation_losses(*parts, self.recipe.distill)
            factor = self._distillation_factor()
            losses |= {name: weighted(value, factor) for name, value in distilled.items()}
        if self.reconstruction is not None and batch.scene is not None:
            with self._autocast():
                mask, offset = reconstruction_losses(
                    self._in_type(self.reconstruction), output.fused, batch.scene, self.recipe.reconstruction_window
                )
            weight = self.recipe.reconstruction
            losses |= {"rec_mask": weighted(mask, weight), "rec_offset": weighted(offset, weight)}
        return losses

    def _distillation_factor(self) -> float:
        """Return the factor of the distillation weights at this step, see `DistillSettings.fade`."""
        fade = self.recipe.distill.fade
        if not fade:
            return 1.0
        done = self.global_step / max(int(self.trainer.estimated_stepping_batches), 1)
        return min(max((1.0 - done) / fade, 0.0), 1.0)

    def _consistency(self, batch: Batch, clean: NetworkOutput) -> Tensor:
        """Return the consistency loss between the two views of a batch; 0 with one view."""
        if batch.view is None or batch.targets is None:
            return clean.cls.new_zeros(())
        with self._autocast():
            view = self._student(batch.view, batch.layout)
        return consistency_loss(view, clean, batch.targets.positive)

    def training_step(self, batch: Batch, batch_index: int) -> Tensor:
        """Return the loss of a batch.

        Raises:
            TrainingAlarm: the loss of this or a recent batch is not a finite number.
        """
        with torch.random.fork_rng():
            # Seeded by the step: a resumed run draws the same, and each device its own.
            torch.manual_seed((self.seed << 32) + (self.global_rank << 28) + self.global_step)
            losses = self.losses(batch)
        loss, values = total(losses.values()), torch.stack([value.detach() for value in losses.values()])
        where = f"epoch {self.current_epoch}, step {self.global_step}, samples {', '.join(batch.keys)}"
        self._unchecked.append((tuple(losses), values, where))
        if len(self._unchecked) == _CHECKED_STEPS or self.trainer.is_last_batch:
            self._check_losses()
        logged = {f"train/{name}": value for name, value in zip(losses, values, strict=True)}
        logged["train/loss"] = loss.detach()
        self.log_dict(logged, on_step=True, on_epoch=True, batch_size=len(batch.keys), sync_dist=True)
        return loss

    def backward(self, loss: Tensor, *args: Any, **kwargs: Any) -> None:
        """Set the gradients of all weights; other than by `loss.backward` nothing is dispatched for each of them.

        Processes that share a training average their gradients while they accumulate.
        """
        if self._trainer is not None and self._trainer.world_size > 1:
            super().backward(loss, *args, **kwargs)
            return
        weights = [weight for weight in self.parameters() if weight.requires_grad]
        for weight, gradient in zip(weights, torch.autograd.grad(loss, weights, allow_unused=True), strict=True):
            weight.grad = None if gradient is None else as_laid_out(gradient, weight)

    def _check_losses(self) -> None:
        """Look at the losses since the last look: at each step, the host would wait for the device."""
        recent, self._unchecked = self._unchecked, []
        found = torch.cat([values for _, values, _ in recent]).tolist()
        for names, _, where in recent:
            values, found = found[: len(names)], found[len(names) :]
            if not all(map(math.isfinite, values)):
                told = ", ".join(f"{name} {value:.3g}" for name, value in zip(names, values, strict=True))
                raise TrainingAlarm(f"training: loss: expected a finite number, found {told} at {where}")

    def validation_step(self, batch: Batch, batch_index: int) -> None:
        """Detect in a batch and keep the result, with late fusion that of each agent."""
        self._results.append(detections_of(self.detector, batch))

    def on_validation_epoch_end(self) -> None:
        """Log the average precisions.

        Raises:
            TrainingAlarm: they were 0 in `alarm_after` validations in a row.
        """
        ap = metrics_of(self._all_results(), self.unseen)
        self._results.clear()
        self.log_dict({name: 0.0 if math.isnan(value) else value for name, value in ap.items()})
        if self.trainer.sanity_checking or math.isnan(ap[prefixed("ap_bev_50", self.unseen)]):
            return
        self._zeros_in_a_row = self._zeros_in_a_row + 1 if ap[prefixed("ap_bev_30", self.unseen)] == 0 else 0
        if self._zeros_in_a_row >= self.recipe.alarm_after:
            raise TrainingAlarm(
                f"training: AP@0.3 on {frames_named(self.unseen)}: expected more than 0 by epoch {self.current_epoch}, "
                f"found 0 in {self._zeros_in_a_row} validations in a row; look at the labels' frame and the learning "
                "rate"
            )

    def on_save_checkpoint(self, checkpoint: dict[str, object]) -> None:
        """Store the count of the alarm, which an interruption does not reset."""
        checkpoint["zeros_in_a_row"] = self._zeros_in_a_row

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Restore the count of the alarm; older checkpoints have none."""
        self._zeros_in_a_row = checkpoint.get("zeros_in_a_row", 0)

    def _all_results(self) -> list[FrameResult]:
        """Gather the results of all devices in the order of the frames."""
        parts = [self._results]
        if self.trainer.world_size > 1:
            parts = [[] for _ in range(self.trainer.world_size)]
            distributed.all_gather_object(parts, self._results)
        by_turns = zip_longest(*parts, fillvalue=[])
        return [result for turn in by_turns for frames in turn for result in frames]

    def configure_optimizers(self) -> Any:
        """Return the optimizer and the schedule, which advances with every step."""
        decayed = [p for p in self.parameters() if p.ndim > 1]
        others = [p for p in self.parameters() if p.ndim <= 1]
        groups = [{"params": decayed, "weight_decay": self.recipe.weight_decay}, {"params": others, "weight_decay": 0}]
        optimizer: torch.optim.Optimizer
        if self.recipe.optimizer == "adam":
            whole, decay = list(self.parameters()), self.recipe.weight_decay
            optimizer = torch.optim.Adam(whole, lr=self.recipe.learning_rate, eps=1e-10, weight_decay=decay, fused=True)
        else:
            optimizer = torch.optim.AdamW(groups, lr=self.recipe.learning_rate, fused=True)
        steps = max(int(self.trainer.estimated_stepping_batches), 1)
        schedule = LambdaLR(optimizer, RateCurve(self.recipe, steps))
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


def as_laid_out(gradient: Tensor, weight: Tensor) -> Tensor:
    """Return a gradient in its weight's order in memory, which a fused optimizer needs."""
    sides = zip(weight.shape, weight.stride(), gradient.stride(), strict=True)
    if all(size == 1 or own == other for size, own, other in sides):
        return gradient
    return torch.empty_like(weight).copy_(gradient)


def as_teacher(teacher: Detector, batch: Batch) -> NetworkOutput:
    """Run a teacher on its clouds; in training, the clouds of its objects enter its pillar norm if the batch has them.

    As in the released code, which encodes both in one batch and continues with the teacher's clouds alone.
    """
    pillars = batch.teacher
    if pillars is None:
        raise ValueError("the batch was collated for another network")
    if batch.objects is None or not teacher.training:
        return teacher(pillars, batch.layout)
    encoder = teacher.encoder
    features = encoder.features(concatenated(pillars, batch.objects))[: len(pillars.coords)]
    stages = teacher.backbone(encoder.scatter(features, pillars))
    return teacher.heads(stages, teacher.fuse(teacher.maps(stages), batch.layout))


def concatenated(first: Pillars, second: Pillars) -> Pillars:
    """Concatenate the pillars of two groups of clouds."""
    shift = torch.zeros_like(second.coords)
    shift[:, 0] = first.clouds
    return Pillars(
        points=torch.cat([first.points, second.points]),
        pillar=torch.cat([first.pillar, second.pillar + len(first.coords)]),
        coords=torch.cat([first.coords, second.coords + shift]),
        count=torch.cat([first.count, second.count]),
        clouds=first.clouds + second.clouds,
        padded=first.padded,
    )


class RateCurve:
    """Learning rate over the steps, relative to its peak: warm-up, then half a cosine; see `Recipe.schedule`."""

    def __init__(self, recipe: Recipe, steps: int) -> None:
        # Plain numbers only: they are in every checkpoint.
        self.steps, self.epochs, self.released = steps, recipe.epochs, recipe.schedule == "released"
        self.rise_epochs = round(recipe.epochs * recipe.warmup)
        self.rise = max(round(steps * recipe.warmup), 1) if recipe.warmup else 0
        self.start, self.end = 0.04, 1e-4 if recipe.schedule == "one_cycle" else 1e-2

    def __call__(self, step: int) -> float:
        """Return the relative rate at a step."""
        if self.released:
            # Once per epoch, and the cosine runs on under the warm-up.
            epoch = step * self.epochs // self.steps
            if epoch < self.rise_epochs:
                return 0.2 + 0.8 * epoch / self.rise_epochs
            return 0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * min(epoch / self.epochs, 1.0)))
        if step < self.rise:
            return self.start + (1 - self.start) * step / self.rise
        fall = min((step - self.rise) / max(self.steps - self.rise, 1), 1.0)
        return self.end + (1 - self.end) * 0.5 * (1 + math.cos(math.pi * fall))
