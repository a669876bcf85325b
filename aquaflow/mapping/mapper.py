"""The map of one sub-map: views in, Gaussians and water out (paper, Sec. 3.3 and 3.4)."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from aquaflow.base.clocks.deadline import Deadline
from aquaflow.base.errors import InputError, is_device_failure, is_device_full
from aquaflow.base.errors.failures import Failures
from aquaflow.config import MappingConfig
from aquaflow.geometry.arrays import Arrays
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Pointmap
from aquaflow.mapping.base_gaussians import BaseGaussians
from aquaflow.mapping.gaussians import (
    COVERED_ALPHA,
    GaussianMap,
    alpha_where_agreed,
    colour_range,
    density_for,
    insertion_probability,
    keep_apart,
    move_gaussians,
    move_views,
    new_gaussians,
    select,
    thin,
    tracked_range,
    worth_keeping,
)
from aquaflow.mapping.looks import absorbed_colours, follow_water, kept_looks
from aquaflow.mapping.neural.neural import NeuralGaussians
from aquaflow.mapping.optimisation import (
    MapOptimiser,
    Objective,
    refining_rates,
    sampled_views,
    share_done,
    shuffled_views,
)
from aquaflow.mapping.registration import register, take_light
from aquaflow.mapping.scene import RenderedMap, Scene
from aquaflow.mapping.scene_water import WaterFitting, rebalance
from aquaflow.mapping.tiles import KEPT_SHARE, Sphere, TileFiles, Tiles
from aquaflow.render.contract import Renderer
from aquaflow.render.gsplat import give_back_after
from aquaflow.render.transfers import insertion_in, insertion_out
from aquaflow.render.views import View, in_time
from aquaflow.water.daylight import Depths
from aquaflow.water.medium import LearnedMedium
from aquaflow.water.tone import ShownTone

MOST_FAILED_STEPS = 10
"""Steps in a row that raise until the final refinement gives up: the next would, too."""
MOST_FULL = 3
"""Steps in a row that find the device's memory full until no further one is tried."""
KNOWN_SIGMA = 0.15
"""Relative range sigma of pixels that may get a Gaussian."""
NEWEST_SHARE = 0.2
"""Share of the steps on the newest view (ARTDECO)."""


class Mapper:
    """Owns the Gaussians, the medium, their optimisers and the views of one sub-map."""

    def __init__(
        self,
        config: MappingConfig,
        renderer: Renderer,
        seed: int,
        failures: Failures | None = None,
        tiles: TileFiles | None = None,
    ) -> None:
        """What a fit or a step raises is counted in ``failures`` and skipped; what has no room in
        memory waits in ``tiles``."""
        self.config, self.renderer = config, renderer
        self.device = renderer.device
        """Where everything that the map is made of lives."""
        self.failures = failures or Failures()
        self._random = torch.Generator().manual_seed(seed)
        self.scene = Scene(config.medium, renderer, self._random, config.sunlight)
        self.views: list[View] = []
        self.tone: tuple[int, ShownTone] | None = None
        """Of restored pictures, and at how many steps it was judged (appearance.py)."""
        self.depths: Depths | None = None
        """Below the surface; None where they are not known."""
        self.metres_per_unit: float | None = None
        """Of the map; None while it is unknown."""
        self.unlimited = 0
        """Gaussians that were made before ``resolution_mm`` could limit them."""
        self._failed_in_a_row = 0
        """Steps that raised, since the last one that did not."""
        if config.decoder.enabled:
            drawn = torch.Generator().manual_seed(seed)  # its own: insertion is as without it
            self.scene.neural = NeuralGaussians(
                config.decoder, self.gaussians, config.optimiser.betas, drawn, renderer.threads
            )
        self.tiles = Tiles(tiles)
        """What of the map waits in files."""
        self._here: list[View] | None = None
        """Views on whose ground nothing waits; None: all."""
        self._objective = Objective(config.loss, renderer.threads)
        self.optimiser = MapOptimiser(config, self.scene, self._objective)
        self.water_fitting = WaterFitting(
            config.medium, self.scene, self._random, self.failures, self.tiles
        )

    # --- growing ------------------------------------------------------------------------------

    def add_view(self, view: View) -> None:
        """Let later optimisation steps use ``view``."""
        self._take(view)
        if view not in self.views:  # it is, where the device failed on it and it comes again
            if self.views:
                view.log_gain, view.light = self.views[-1].log_gain, self.views[-1].light
            self.views.append(view)
            if self._here is not None:
                self._here.append(view)
        if self.water_fitting.go_on(self.views, self._here):
            with self.failures.contain("sunlight"):
                self.scene.sunlight.judge(in_time(self.views))

    def forget(self, views: Sequence[View]) -> None:
        """These are no longer among the map's views."""
        for view in views:
            if self._here is not None and view in self._here:
                self._here.remove(view)

    def _take(self, view: View) -> None:
        """Let the view's tensors be where the map is."""
        if view.device.type != self.device.type:
            view.begin_on(self.device)

    @torch.no_grad()
    def insert(
        self,
        view: View,
        pointmap: Pointmap,
        base: Sequence[tuple[BaseGaussians, Sim3]] = (),
    ) -> int:
        """Medium-guided insertion (paper, Sec. 3.3.3); returns the number of new Gaussians.

        ``base``: of an earlier dive, each with its T_mb; what of them ``view`` shows comes first.
        """
        config = self.config.insertion
        self._take(view)

        # The range of every pixel as tracked; the view keeps it for the depth loss (Eq. 21).
        tracked = tracked_range(pointmap, KNOWN_SIGMA)
        tracked.keep_in(view)
        tracked = tracked.on(self.device)
        tracked_z = tracked.z * view.T_wc.scale
        ground = self._come_to(view, tracked_z[tracked.known])
        for gaussians, T_mb in base:  # not in the paper
            self._take_over(view, tracked_z, gaussians, T_mb, ground)

        # J-tilde, alpha and range of the map as it is, drawn from the view.
        shown = self.scene.show(view, learn=True)

        # Eq. 16: J-hat, the picture without the medium, over the tracked range or the map's.
        covered = shown.alpha > COVERED_ALPHA
        z = torch.where(tracked.known, tracked_z, torch.where(covered, shown.z, 0.0))
        J_hat, recoverable = self._restore(view, colour_range(z, shown.z, covered, config))

        # Eq. 17: P_a, the structure of J-hat that J-tilde does not have yet.
        agreed_alpha = alpha_where_agreed(shown.alpha, shown.z, tracked_z, config)
        P_a = insertion_probability(J_hat, shown.radiance, agreed_alpha, config)

        # Pixels where that is enough, or drawn with that probability.
        allowed = tracked.known & recoverable & view.scene_mask()
        density = density_for(config.density, len(self.gaussians) / self.config.max_gaussians)
        spacing = self._spacing_px(view, z)
        rows, columns = select(P_a, allowed, density, config, self._random, spacing)

        # As far apart on the ground as is asked for.
        if spacing is not None:
            rows, columns = keep_apart(
                view, rows, columns, z, spacing, self.gaussians.means, config, self._random
            )

        # Room for them below the hard cap.
        rows, columns = self._make_room(rows, columns, agreed_alpha < COVERED_ALPHA, ground)

        # Gaussians on the rays of these pixels.
        if len(rows) == 0:
            return 0
        sure = tracked.confidence
        new = new_gaussians(view, rows, columns, z, J_hat, sure, P_a, density, config, spacing)
        if spacing is None and self.config.resolution_mm is not None:
            self.unlimited += len(rows)
        return self._append(new, view)

    def _spacing_px(
        self,
        view: View,
        z: Tensor,  # [H, W]
    ) -> Tensor | None:
        """[H, W] between Gaussians, as ``resolution_mm`` asks; None where it says nothing, or the
        map's unit is not known."""
        resolution_mm = self.config.resolution_mm
        if resolution_mm is None or self.metres_per_unit is None:
            return None
        spacing = resolution_mm / 1000.0 / self.metres_per_unit
        return spacing * view.camera.fx / z.clamp_min(1e-6)

    def _restore(
        self,
        view: View,
        z: Tensor,  # [H, W]
    ) -> tuple[Tensor, Tensor]:
        """J-hat [H, W, 3], and where the medium lets colours be recovered [H, W]."""
        J_hat, recoverable = self.scene.restore(view, z)
        return J_hat if self.config.insertion.medium_reduced else view.target(), recoverable

    def _make_room(
        self,
        rows: Tensor,  # [M]
        columns: Tensor,  # [M]
        bare: Tensor,  # [H, W] bool
        ground: Sphere | None,  # what is seen
    ) -> tuple[Tensor, Tensor]:
        """The pixels that may get a Gaussian. In a full memory far tiles leave; where none may,
        only bare pixels do, and a share of the Gaussians, those least worth keeping, makes room."""
        if len(rows) > self.config.max_gaussians - len(self.gaussians):
            self._let_leave(ground)
        count = len(self.gaussians)
        room = self.config.max_gaussians - count
        if len(rows) > room:
            chosen = bare[rows, columns]
            rows, columns = rows[chosen], columns[chosen]
        recycled = min(len(rows) - room, int(self.config.insertion.recycle * count))
        if recycled > 0:
            self.optimiser.keep(worth_keeping(self.gaussians, count - recycled))
            room += recycled
        return thin(rows, columns, room, self._random)

    def _take_over(
        self,
        view: View,
        tracked_z: Tensor,  # [H, W] map units, 0 where unknown
        base: BaseGaussians,
        T_mb: Sim3,
        ground: Sphere | None,  # what is seen
    ) -> None:
        """Of the ``base`` what lies on the surface that ``view`` shows and the map does not."""
        z = insertion_out(torch.where(view.scene_mask(), tracked_z, 0.0))
        found = base.on_surface(view, T_mb, torch.from_numpy(z))
        if found is None:
            return
        if len(self.gaussians):
            shown = self.scene.show(view)
            agreed = alpha_where_agreed(shown.alpha, shown.z, tracked_z, self.config.insertion)
            covered = insertion_out(agreed > COVERED_ALPHA)[found.rows, found.columns]
            base.leave(found.only(covered))
            found = found.only(~covered)
        if len(found.numbers) > self.config.max_gaussians - len(self.gaussians):
            self._let_leave(ground)
            room = max(self.config.max_gaussians - len(self.gaussians), 0)
            drawn = torch.randperm(len(found.numbers), generator=self._random)[:room]
            found = found.only(drawn.numpy())
        if len(found.numbers) == 0:
            return
        J_hat, recoverable = self._restore(view, tracked_z)
        taken = base.take(found, T_mb, insertion_out(J_hat), insertion_out(recoverable))
        self._append({n: insertion_in(t, self.device) for n, t in taken.items()}, view)

    def _append(
        self,
        new: dict[str, Tensor],  # each [M, ...], of a GaussianMap
        view: View,
    ) -> int:
        self.scene.go_on()
        count = len(new["means"])
        self.gaussians.extend(new, view.keyframe)
        self.optimiser.extend(count, view.centre())
        return count

    # --- what waits in files ------------------------------------------------------------------

    @property
    def count(self) -> int:
        """Gaussians of the map, those that wait in files included."""
        return len(self.gaussians) + len(self.tiles)

    def _come_to(
        self,
        view: View,
        z: Tensor,  # [M] ranges of what the view shows, map units
    ) -> Sphere | None:
        """Bring back what waits on the ground that ``view`` shows; where that is, as far as it is
        known, and where something can wait."""
        if len(z) == 0:
            return None
        ground = self.tiles.look(view, float(z.median()))
        if not self.tiles.files.usable or self.device.type != "cpu" or self.neural is not None:
            return None
        self._bring(self.tiles.near(ground))
        if len(self.gaussians) > self.config.max_gaussians:
            self._let_leave(ground)
        return ground

    def _let_leave(self, ground: Sphere | None) -> None:
        """Let tiles far from ``ground`` leave memory, until a share of it is free."""
        if ground is None:
            return
        kept = int(KEPT_SHARE * self.config.max_gaussians)
        self._release(self.tiles.far(self.gaussians, ground, len(self.gaussians) - kept))

    def _release(self, keyframes: Sequence[int]) -> None:
        """Let these tiles leave memory."""
        if not keyframes:
            return
        self.scene.go_on()
        self.optimiser.settle()
        seen = kept_looks(self.scene, self.views)
        stay = self.tiles.leave(self.gaussians, self.optimiser.adam, keyframes, seen)
        self.optimiser.keep(stay)
        self._find_views_here()

    def _bring(self, keyframes: Sequence[int]) -> None:
        """Let these tiles be in memory again, where they look as they did when they left."""
        if not keyframes:
            return
        self.scene.go_on()
        whole, states = GaussianMap(), list[Arrays]()
        for keyframe in keyframes:
            with self.failures.contain("tile of the map"):
                tile, arrays = self.tiles.bring(keyframe)
                whole.append(tile)
                states.append(arrays)
        if states:
            with self.failures.contain("tile of the map"):
                follow_water(self.scene, self.views, whole, states)
            self.gaussians.append(whole)
            self.optimiser.take_back(states)
        self._find_views_here()

    def _come_back_to(self, view: View) -> None:
        """Let the ground that ``view`` shows be in memory."""
        if self.tiles.waiting and view.keyframe in self.tiles.seen:
            self._fill_around(self.tiles.seen[view.keyframe])

    def _fill_around(self, ground: Sphere) -> None:
        """Let as much of what lies around ``ground`` be in memory as there is room for."""
        leaving, coming = self.tiles.around(self.gaussians, ground, self.config.max_gaussians)
        self._release(leaving)
        self._bring(coming)

    @property
    def _views_here(self) -> list[View]:
        return self.views if self._here is None else self._here

    def _find_views_here(self) -> None:
        if not self.tiles.waiting:
            self._here = None
            return
        known = self.tiles.open_keyframes()
        self._here = [view for view in self.views if view.keyframe in known]

    def resume_tiles(
        self,
        arrays: Arrays,  # as from Tiles.serialise; none of an older checkpoint
    ) -> None:
        """Let what waited in files at a checkpoint do so again; what was lost is counted."""
        if not arrays:
            return
        with self.failures.contain("tile of the map"):
            lost = self.tiles.restore(arrays)
            self._find_views_here()
            if lost:
                raise InputError(f"files of {lost} Gaussians that waited were lost")

    def gather(self) -> None:
        """Let the whole map be in memory, whatever its size."""
        self._bring(sorted(self.tiles.waiting))

    # --- following the keyframes --------------------------------------------------------------

    def move(self, moves: Mapping[int, Sim3]) -> None:
        """Let Gaussians and views follow moved keyframes (see gaussians.py)."""
        self.scene.go_on()
        moved = move_gaussians(self.gaussians, moves)
        if self.neural is not None:
            self.neural.move(moved)
        move_views(self.views, moves)
        self.tiles.move(moves)
        self._change_unit(moves)
        self.water_fitting.follow_moves(moves)

    def _change_unit(self, moves: Mapping[int, Sim3]) -> None:
        """The water's rates are per map unit: as much as that has changed on the mean."""
        keyframes = {view.keyframe for view in self.views}
        logs = [math.log(moves[number].scale) for number in keyframes & moves.keys()]
        if any(logs):
            scale = math.exp(sum(logs) / len(keyframes))
            self.scene.use_unit_and_light(scale, torch.ones(3, device=self.device))

    def use_unit(self, metres_per_unit: float) -> None:
        """The map's unit is known in metres, in which spacing and a decoder's voxels are given."""
        self.metres_per_unit = metres_per_unit
        if self.neural is not None:
            self.neural.use_unit(metres_per_unit)

    def absorb(self, other: Mapper) -> None:
        """Take over another sub-map's Gaussians and views, already moved into this one's world.

        The water stays this map's own: it is the same water, and is fitted again to all views; till
        then the other's Gaussians get the colours that look the same in it. So does the decoder:
        what the other's says of its Gaussians, seen from its own views, is kept.
        """
        self.scene.go_on()
        before, count = len(self.gaussians), len(other.gaussians)
        views = in_time(dict.fromkeys([*self.views, *other.views]))
        # Only a decoder needs to know from where each is seen: cameras times Gaussians.
        centres = None if self.neural is None else other.scene.bake(other.views)
        colours = absorbed_colours(self.scene, other.scene, other.views)
        self.gaussians.append(other.gaussians)
        self.gaussians.parameters["raw_colours"][before:] = colours
        self.tiles.absorb(other.tiles)
        self.water_fitting.merge(views)
        self.views = views  # from here on make_whole mends what a failure leaves
        self.optimiser.extend(count, centres)
        self.optimiser.steps += other.steps
        self.optimiser.undone += other.undone
        self.unlimited += other.unlimited
        self._find_views_here()

    # --- optimising ---------------------------------------------------------------------------

    def optimise(self, steps: int) -> None:
        """Steps on the newest view now and then, else on any (paper, Sec. 3.4)."""
        self.scene.go_on()
        if len(self.gaussians) == 0:
            return
        chosen = sampled_views(self._views_here, steps, NEWEST_SHARE, self._random)
        self.scene.centre_water(self.views)
        with self.scene.learning_from(chosen), self.optimiser.stepping():
            for view in chosen:
                self._contained_step("optimisation", view, refine_poses=False)

    @property
    def refining_steps(self) -> int:
        """Steps of the final refinement: those asked for, for as much of the map as has room in
        memory, so that the ground of a long dive gets what that of a short one does."""
        parts = max(self.count / self.config.max_gaussians, 1.0)
        return round(self.config.optimiser.refine_steps * parts)

    def refine(
        self,
        progress: Callable[[int, int], None] | None = None,
        until: Deadline | None = None,
    ) -> None:
        """The final refinement: all views in random order, rates falling, poses included; as much
        of it as there is time ``until`` then."""
        self.scene.go_on()
        steps, until = self.refining_steps, until or Deadline()
        done = itertools.count(1)

        def stepped() -> None:
            if progress is not None:
                progress(next(done), steps)

        if not until.over:
            self.water_fitting.at_once(self.views, self._come_back_to)
        if self.tiles.waiting:
            self._refine_by_turns(steps, stepped, until)
        else:
            self._refine_views(self.views, steps, stepped, until)
        with self.failures.contain("white balance"):
            rebalance(self.scene)

    def _refine_by_turns(self, steps: int, stepped: Callable[[], None], until: Deadline) -> None:
        """Ground after ground, in the order in which the dive saw it, each with its share of steps
        and time by its views."""
        views = Counter(view.keyframe for view in self.views if view.keyframe in self.tiles.seen)
        whole, done = views.total(), 0
        while views and not until.over:
            keyframe, left = min(views), views.total()
            self._fill_around(self.tiles.seen[keyframe])
            turn = [view for view in self._views_here if view.keyframe in views]
            for each in {keyframe, *(view.keyframe for view in turn)}:
                del views[each]
            share = round(steps * (1.0 - views.total() / whole)) - done
            self._refine_views(turn, share, stepped, until.share(1.0 - views.total() / left))
            done += share

    def _refine_views(
        self, views: Sequence[View], steps: int, stepped: Callable[[], None], until: Deadline
    ) -> None:
        order = shuffled_views(views, steps, self._random) if len(self.gaussians) else []
        with self.scene.learning_from(order), self.optimiser.stepping():
            for step, view in enumerate(order):
                passed = until.passed
                if passed >= 1.0:
                    break
                if step % len(views) == 0:
                    self.judge_light(views)
                if not self.refine_step(view, share_done(step, steps, passed)):
                    break
                stepped()

    def judge_light(self, views: Sequence[View]) -> None:
        """Between rounds of refining ``views``: light shows once the map has lost its errors."""
        self.scene.sunlight.judge(in_time(views))
        self.scene.centre_water(views)

    def refine_step(self, view: View, done: float) -> bool:
        """A step of refining, of which the share ``done`` is over; False where further ones would
        fail as the last have."""
        self.optimiser.slow_down(refining_rates(done, self.config.optimiser))
        self._contained_step("refinement", view, self.config.optimiser.poses > 0.0)
        return self._failed_in_a_row < MOST_FAILED_STEPS

    def _contained_step(self, stage: str, view: View, refine_poses: bool) -> None:
        """The first view's pose is never refined: it fixes the map's frame."""
        with self.failures.contain(stage, view.frame_index) as step:
            self.optimiser.step(view, refine_poses and view is not self.views[0])
        self._failed_in_a_row = self._failed_in_a_row + 1 if step.failed else 0
        if step.error is not None:
            if self._is_hopeless(step.error):
                raise step.error
            if is_device_full(step.error):
                give_back_after(step.error, self.device)
            self.make_whole()

    def _is_hopeless(self, error: Exception) -> bool:
        """True if no later step would do better: the device is gone, or full again and again."""
        if self.device.type == "cpu" or not is_device_failure(error):
            return False
        return not is_device_full(error) or self._failed_in_a_row >= MOST_FULL

    def make_whole(self) -> None:
        """After a failure: every Gaussian is finite and has its row in the optimisers."""
        self.scene.go_on()
        self.optimiser.make_whole()

    # --- looking ------------------------------------------------------------------------------

    def show(self, view: View) -> RenderedMap:
        """The map from ``view``."""
        self._take(view)
        return self.scene.show(view)

    def take_light(self, view: View) -> None:
        """Give a held-out view the exposure and the light of the views before and after."""
        self._take(view)
        take_light(view, in_time(self.views))

    def register(self, view: View) -> None:
        """Refine the pose of a held-out view photometrically against the frozen map."""
        self._take(view)
        register(view, self.scene, self.config.optimiser)

    @property
    def neural(self) -> NeuralGaussians | None:
        """The scene's decoder; None without one."""
        return self.scene.neural

    @property
    def gaussians(self) -> GaussianMap:
        """The scene's Gaussians."""
        return self.scene.gaussians

    @property
    def medium(self) -> LearnedMedium:
        """The scene's medium."""
        return self.scene.medium

    @property
    def steps(self) -> int:
        """Steps of the optimiser so far."""
        return self.optimiser.steps

    @property
    def undone(self) -> int:
        """Steps that were undone because their loss or gradient was not finite."""
        return self.optimiser.undone
