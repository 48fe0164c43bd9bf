"""From corners set by hand to the real edges and corners in the image, or to the reason why they aren't found.

The corners are only rough.  Many poses that agree with them are tried, coarsely first; the measurement at the best one
is what the monitor itself would measure there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from gripmon.model.camera import Camera
from gripmon.model.geometry import perturb
from gripmon.model.gripper import Gripper, on_a_line
from gripmon.model.records import Array, CornerFault, Image
from gripmon.monitor.tracker import USUAL_SHARE
from gripmon.teach.corner_pose import PlacedPose, Prior, Snapped, SnappedCorner, place, rough_sigma_px
from gripmon.teach.views import NARROW
from gripmon.track.edges import FingertipMeter, Measurement, MeasurementSettings
from gripmon.track.edges.settling import ZOOMS, Expected

FEWEST_PUT = 3
"""Corners that must be set by hand before edges are searched for, where there is no reference: three leave up to four
poses (Grunert, 1841), of which the edges tell the right one."""

SURE_SHARE = 0.8
"""Inlier ratio from which no other pose is tried."""

FARTHEST_SIGMAS = 6.0
"""Largest distance of the gripper from the corners set by hand, in their standard deviations (root mean square)."""

MISFIT_SIGMAS = (4.0, 12.0)
"""Distance of a corner from where all together predict it, in its standard deviations: from which it is named if
nothing is found, and from which it must be mislabelled.
"""

MIRRORED_GAIN = 1.25
"""Factor by which mirrored corners must fit better before they are reported as exchanged."""

_POSES_AROUND = 24  # number of poses around that of the corners
_POSES_KEPT = (6, 3)  # how many of them continue to the next finer zoom
_OPENINGS, _OPENING_CHI2 = 9, 4.0  # openings tried where none is reported; gain in χ² needed to take another one
_TWIN_MISFIT = 0.25  # largest misfit of mirrored corners, over the smallest distance between two

ON_A_LINE = (
    "the corners lie on a line, and no edges show the gripper's rotation about it; one more corner beside it, the "
    "rough distance (--distance M:SIGMA), or a hand/eye calibration (--reference FILE)"
)
MIRRORED = "mirrored, these corners fit better; the fingers, or near and far, have each other's names?"
NOTHING_SEEN = "no fingers are seen here; corners nearer to the tips"
"""Reasons why nothing was found, with what would help."""

REASONS = {
    CornerFault.OUTSIDE: "outside of the image",
    CornerFault.SELF_HIDDEN: "hidden by its own finger",
    CornerFault.FEW_POINTS: "fewer than two edges in view",
    CornerFault.HIDDEN: "its edges aren't visible close to it",
    CornerFault.PARALLEL: "its edges are nearly parallel",
    CornerFault.UNCERTAIN: "too uncertain",
    CornerFault.NO_FIT: "no edges found",
}


class Snapper:
    """Finds one gripper in the images of one camera from corners set by hand."""

    def __init__(self, camera: Camera, gripper: Gripper, settings: MeasurementSettings, jaw_sigma_m: float):
        self.camera, self.gripper, self._settings, self._jaw_sigma_m = camera, gripper, settings, jaw_sigma_m

    def snap(
        self, image: Image, put_px: Mapping[str, Array], jaw_opening_m: float | None, prior: Prior, known: bool
    ) -> tuple[Snapped, Measurement | None]:
        """Search for the gripper; what is seen, and the measurement of it, None where nothing is found.

        ``put_px`` (name: (2,)): the corners set by hand; ``jaw_opening_m`` None where it isn't reported; ``known``: the
        prior is a calibration, so that no corner has to be set.  Never raises because of the image's content.
        """
        start_m = self._opening(put_px, prior) if jaw_opening_m is None else jaw_opening_m
        placed = place(self.camera, self.gripper, start_m, put_px, prior)
        if not known and len(put_px) < FEWEST_PUT:
            left = FEWEST_PUT - len(put_px)
            return self._rough(placed[0], start_m, f"place {left} more corner{'s' * (left > 1)} on the fingertips")
        if (misfit := self._misfit(placed[0], MISFIT_SIGMAS[1])) is not None:
            return self._rough(placed[0], start_m, misfit)
        # Only the edges can show the gripper's turn about such a line; if they don't, that is the reason.
        line = None if known or not self._on_a_line(put_px) else ON_A_LINE
        found = self._found(image, placed, start_m, jaw_opening_m is not None)
        if not known and self._mirrored_fits(image, put_px, start_m, jaw_opening_m is not None, prior, found):
            return self._rough(placed[0], start_m, line or MIRRORED)
        if found is None or not found.trusted:
            why = self._misfit(placed[0], MISFIT_SIGMAS[0]) or line or NOTHING_SEEN
            return self._rough(placed[0], start_m, why)
        away_px = self._away_px(found, put_px)
        if away_px > FARTHEST_SIGMAS * rough_sigma_px(self.camera):
            far = f"{away_px:.0f} px from your corners" if np.isfinite(away_px) else "out of the lens's view"
            why = f"the edges found lie {far}; corners nearer to the fingertips"
            return self._rough(placed[0], start_m, line or why)
        return self._measured(found, jaw_opening_m)

    def _found(
        self, image: Image, placed: Sequence[PlacedPose], jaw_opening_m: float, reported: bool
    ) -> Measurement | None:
        """The best measurement from any of the poses."""
        best: Measurement | None = None
        for pose in placed[:2]:
            if reported and best is None:
                best = self._measure(image, pose.cam_T_grip, jaw_opening_m, reported)
                if best.consensus.share >= SURE_SHARE:
                    return best
            meter = _Meter(self.camera, self.gripper, self._settings, self._jaw_sigma_m)
            near = meter.followed(image, pose, jaw_opening_m, reported)
            tried = self._measure(image, near.cam_T_grip, near.jaw_opening_m, reported)
            if best is None or _worth(tried) > _worth(best):
                best = tried
            if best.consensus.share >= SURE_SHARE:
                break
        return best

    def _opening(self, put_px: Mapping[str, Array], prior: Prior) -> float:
        """The jaw opening that fits the corners set by hand best, if it is clearly better than the nominal one."""
        gripper = self.gripper
        if not gripper.has_jaw or len(put_px) < FEWEST_PUT:
            return gripper.jaw_nominal_m
        tried = [gripper.jaw_nominal_m, *np.linspace(gripper.jaw_min_m, gripper.jaw_max_m, _OPENINGS).tolist()]
        costs = [place(self.camera, gripper, opening_m, put_px, prior)[0].cost for opening_m in tried]
        best = int(np.argmin(costs))
        return tried[best] if costs[best] < costs[0] - _OPENING_CHI2 else tried[0]

    def _mirrored_fits(
        self,
        image: Image,
        put_px: Mapping[str, Array],
        opening_m: float,
        reported: bool,
        prior: Prior,
        found: Measurement | None,
    ) -> bool:
        """Whether the image fits clearly better if both fingers' corners are exchanged: four corners in a plane also
        have a pose seen from behind.
        """
        worth = 0.0 if found is None else _worth(found)
        twins = _twins(self.gripper, opening_m)
        if worth >= SURE_SHARE or twins is None:
            return False
        placed = place(self.camera, self.gripper, opening_m, {twins[name]: at for name, at in put_px.items()}, prior)
        if self._misfit(placed[0], MISFIT_SIGMAS[0]) is not None:
            return False
        other = self._found(image, placed, opening_m, reported)
        return other is not None and other.trusted and _worth(other) > MIRRORED_GAIN * worth

    def _measure(self, image: Image, cam_T_grip: Array, jaw_opening_m: float, reported: bool) -> Measurement:
        meter = _Meter(self.camera, self.gripper, self._settings, self._jaw_sigma_m)
        return meter.measure(image, cam_T_grip, jaw_opening_m, USUAL_SHARE, NARROW, reported)

    def _misfit(self, placed: PlacedPose, sigmas: float) -> str | None:
        """The corner that fits the others least, as a text, if it is farther away than ``sigmas``; else None."""
        name, away_px = max(placed.left_px.items(), key=lambda item: item[1], default=("", 0.0))
        if away_px <= sigmas * rough_sigma_px(self.camera):
            return None
        beside = f"{away_px:.0f} px from where the others put it"
        where = beside if np.isfinite(away_px) else "put outside the lens's view by the others"
        return f"{name} is {where}; another corner, or another jaw opening?"

    def _on_a_line(self, put_px: Mapping[str, Array]) -> bool:
        """Whether the corners set by hand lie on one line of the gripper."""
        put = [name in put_px for name in self.gripper.corner_ids]
        return on_a_line(self.gripper.points_grip_m()[self.gripper.corner_points[put]])

    def _away_px(self, found: Measurement, put_px: Mapping[str, Array]) -> float:
        """Root mean square distance between the corners set by hand and those of the measured gripper; infinite where
        the lens can't map one of them.
        """
        if not put_px:
            return 0.0
        model_px = self._corners_px(found.cam_T_grip, found.jaw_opening_m)
        apart = [model_px[name] - np.asarray(at) for name, at in put_px.items()]
        return float(np.nan_to_num(np.sqrt(np.mean(np.square(apart).sum(axis=1))), nan=np.inf))

    def _corners_px(self, cam_T_grip: Array, jaw_opening_m: float | None) -> dict[str, Array]:
        points_m = self.gripper.points_grip_m(jaw_opening_m)[self.gripper.corner_points]
        uv_px = self.camera.project(points_m @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3])
        return dict(zip(self.gripper.corner_ids, uv_px, strict=True))

    def _rough(self, placed: PlacedPose, opening_m: float, why: str) -> tuple[Snapped, None]:
        pose = placed.cam_T_grip
        corners = tuple(
            SnappedCorner(name, _known(at), None, None, None, None, REASONS[CornerFault.NO_FIT])
            for name, at in self._corners_px(pose, opening_m).items()
        )
        return Snapped(
            cam_T_grip=pose,
            corners=corners,
            outlines_px=outlines_px(self.camera, self.gripper, pose, opening_m),
            edge_points_px=np.zeros((0, 2)),
            share=0.0,
            jaw_opening_m=opening_m if self.gripper.has_jaw else None,
            refused=why,
        ), None

    def _measured(self, found: Measurement, jaw_opening_m: float | None) -> tuple[Snapped, Measurement]:
        gripper = self.gripper
        has_jaw = gripper.has_jaw
        opening_m = found.jaw_opening_m if jaw_opening_m is None else jaw_opening_m
        jaw_sigma_m = self._jaw_sigma_m
        if has_jaw and jaw_opening_m is None:
            jaw_sigma_m = float(np.sqrt(found.covariance[6, 6]))
        model_px = self._corners_px(found.cam_T_grip, found.jaw_opening_m if has_jaw else None)
        sample = found.candidates.sample[found.consensus.weight > 0.0]
        offset_px = found.candidates.offset_px[found.consensus.weight > 0.0]
        prediction = found.prediction
        return Snapped(
            cam_T_grip=found.cam_T_grip,
            corners=tuple(self._corner(found, k, name, model_px[name]) for k, name in enumerate(gripper.corner_ids)),
            outlines_px=outlines_px(self.camera, gripper, found.cam_T_grip, found.jaw_opening_m),
            edge_points_px=prediction.uv_px[sample] + offset_px[:, None] * prediction.normal[sample],
            share=float(found.consensus.share),
            jaw_opening_m=opening_m if has_jaw else None,
            jaw_sigma_m=jaw_sigma_m if has_jaw else None,
        ), found

    def _corner(self, found: Measurement, index: int, name: str, model_px: Array) -> SnappedCorner:
        corners, consensus, layout = found.corners, found.consensus, found.prediction.layout
        mine = np.isin(layout.edge, self.gripper.edges_at_corner(index)) & found.prediction.ok
        inliers = float(consensus.supported[mine].mean()) if mine.any() else None
        fault = corners.fault[index]
        if fault is not None:
            return SnappedCorner(name, _known(model_px), None, None, None, inliers, REASONS.get(fault, fault.value))
        lens = found.prediction.corners.d_uv_d_xy[index]
        covariance_px = lens @ corners.covariance_xy[index] @ lens.T
        sigma_px = float(corners.sigma_px[index])
        return SnappedCorner(name, _known(model_px), corners.uv_px[index], covariance_px, sigma_px, inliers, None)


def _known(at: Array) -> Array | None:
    """A position (2,); None beyond the lens."""
    return at if np.isfinite(at).all() else None


def _twins(gripper: Gripper, jaw_opening_m: float | None) -> dict[str, str] | None:
    """Each corner's counterpart on the other finger; None where the fingers aren't mirror images of each other."""
    at = gripper.points_grip_m(jaw_opening_m)[gripper.corner_points]
    apart = np.linalg.norm(at[:, None] * [-1.0, 1.0, 1.0] - at, axis=2)
    nearest = apart.argmin(axis=1)
    between = np.linalg.norm(at[:, None] - at, axis=2) + np.where(np.eye(len(at)), np.inf, 0.0)
    if apart.min(axis=1).max() > _TWIN_MISFIT * between.min() or (nearest[nearest] != np.arange(len(at))).any():
        return None
    names = gripper.corner_ids
    return {name: names[twin] for name, twin in zip(names, nearest.tolist(), strict=True)}


def outlines_px(
    camera: Camera, gripper: Gripper, cam_T_grip: Array, jaw_opening_m: float | None, points: int = 17
) -> dict[str, Array]:
    """Image of the visible edges: name: (points, 2), px, without points that the lens can't map."""
    points_m = gripper.points_grip_m(jaw_opening_m)
    eye_m = -cam_T_grip[:3, :3].T @ cam_T_grip[:3, 3]
    edges = np.flatnonzero(gripper.edge_view(points_m, eye_m).visible)
    out = {}
    for edge, line_m in zip(edges.tolist(), gripper.outlines_m(points_m, edges, points), strict=True):
        uv_px = camera.project(line_m @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3])
        if np.isfinite(uv_px).all(axis=1).sum() > 1:
            out[gripper.edge_ids[edge]] = uv_px[np.isfinite(uv_px).all(axis=1)]
    return out


def _worth(measurement: Measurement) -> float:
    """Inlier ratio, weighted by the part of the edges that show it: a single finger can fit anywhere along itself."""
    edges = measurement.prediction.layout.edges
    seen = np.count_nonzero(measurement.consensus.edge_seen[edges]) / max(len(edges), 1)
    return measurement.consensus.share * seen * (1.0 if measurement.trusted else 0.5)


class _Meter(FingertipMeter):
    """Tries many poses, with a coarse zoom first, whose search lines reach farther."""

    def followed(self, image: Image, placed: PlacedPose, jaw_opening_m: float, reported: bool) -> Expected:
        """The most promising pose among those that the corners set by hand allow."""
        self._prior = self._prior_reported if reported else self._prior_unreported
        variances, axes = np.linalg.eigh(placed.covariance)  # corners nearly on a line leave one that rounding takes
        root = axes * np.sqrt(np.maximum(variances, 0.0))
        poses = [perturb(placed.cam_T_grip, root @ offset) for offset in _spread(_POSES_AROUND)]
        starts = [Expected(pose, jaw_opening_m, jaw_opening_m) for pose in poses if pose[2, 3] > 0.0]
        for zoom, kept in zip((ZOOMS[2], ZOOMS[1]), _POSES_KEPT, strict=True):
            self._zoom = zoom
            places = sorted((self._tried(image, start) for start in starts), key=lambda at: -at.share)
            starts = [at.expected for at in places[:kept]]
        self._zoom = ZOOMS[0]
        return max((self._tried(image, start) for start in starts), key=lambda at: at.share).expected


def _spread(count: int) -> Array:
    """Standard normal offsets (count, 6) without gaps or clusters, the first one zero."""
    from scipy.stats import norm, qmc

    # Deterministic: the same corners give the same result.
    points = qmc.Halton(6, scramble=False).random(count + 1)[1:]
    offsets = norm.ppf(points)
    offsets[0] = 0.0
    return np.asarray(offsets, dtype=float)
