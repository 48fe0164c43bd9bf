"""Why a row of ``tools/bench accuracy`` misses what is to be reached: found by looking, shown beside the verdict."""

from __future__ import annotations

_TEXTURE = (
    "Texture behind the outline shifts single edge points by 0.1 to 0.3 px; three hundred of them "
    "average to 0.02 to 0.03 px an edge, "
    "which is 3 µm across and 20 to 30 µm along the axis. The covariance says so. More profiles "
    "hardly help (800 instead of 320: a tenth "
    "less), since neighbours see the same texture; fits of steps with a slope on each side, and "
    "filters matched to textures of several "
    "lengths, were tried and scattered more. What is left averages out as the background moves "
    "(see the smoothed transform)"
)
_OPENING = (
    "Opening and distance look alike: with the opening free, one frame is three times less certain "
    "along the axis than with a known one. "
    "The report's own error changes from frame to frame here, so that nothing of it can be learnt"
)
_BLUR = (
    "Blurred background edges run into the fingers' own, and neighbouring edges of a finger into "
    "each other (0.1 px at 3 px of blur): "
    "a bias that the residuals don't show, so that the covariance is too small as well"
)

WHY: dict[str, str] = {
    "clean": "0.01 to 0.02 px of bias by the phase of the pixels is left, along the axis a few µm.",
    "standing": (
        "0.01 to 0.02 px of bias by the phase of the pixels is left; the covariance allows 0.02 widths "
        "of an edge for it."
    ),
    "ordinary": f"{_TEXTURE}.",
    "clutter printed": f"{_TEXTURE}; contrast 0.9 here.",
    "clutter chequer": f"{_TEXTURE}.",
    "clutter still": f"{_TEXTURE}, but here it stands still.",
    "grasp": f"Fewer edges are left. {_TEXTURE}.",
    "hand": f"{_TEXTURE}; while the hand moves in and out edges are missing.",
    "finger gone": (
        "One finger alone gives scale and tilt from a few centimetres: the covariance holds it, the "
        "verdict is `suspect`. Lost where less than 0.3 of all profiles agree, of which half are in vain."
    ),
    "defocus 1 px": f"{_TEXTURE}, and twice as much of it under each edge.",
    "defocus 2 px": f"{_BLUR}.",
    "defocus 3 px": f"{_BLUR}.",
    "smeared table": f"{_TEXTURE}.",
    "smeared gripper": f"{_TEXTURE}.",
    "noise": f"{_TEXTURE}; noise of 7 DN hides the weaker edges, and frames with too few of them are held.",
    "saturation": (
        "The bright side of the edges is cut off, which shifts them by up to a width of the edge "
        "towards the dark side. By how "
        "much can't be told without knowing the lens's blur exactly (tried: the shift from width and shape of what is "
        "left, which took sharp edges before white for cut off ones); the covariance allows for it."
    ),
    "shadow": f"{_TEXTURE}; the shadow's own border counts as texture.",
    "flicker": f"{_TEXTURE}.",
    "highlights": f"{_TEXTURE}; bright streaks along creases and bevels beside the outlines.",
    "jpeg": f"{_TEXTURE}; blocks of 8 px repeat one error along short edges.",
    "jaw exact": f"{_TEXTURE}.",
    "jaw noise": f"{_OPENING}.",
    "jaw offset": f"{_OPENING} until the offset is learnt.",
    "jaw offset untold": f"{_OPENING} until the offset is learnt.",
    "jaw unreported": f"{_OPENING}.",
    "bevel untaught": "Meant to miss: this is what `gripmon teach` is for.",
    "bevel taught": f"{_TEXTURE}; what was taught carries the clutter of its own images.",
    "vibration": f"{_TEXTURE}.",
    "bump 1.5 mm": f"{_TEXTURE}.",
    "bump 4.5 mm": f"{_TEXTURE}.",
    "rendered clean": (
        f"{_OPENING}; its frames are unrelated. The white table is as bright as 8 bits go, which counts "
        f"as perhaps cut off."
    ),
    "rendered static_background": (
        f"{_OPENING} until it is learnt: thirty frames begin with ten of learning. {_TEXTURE}."
    ),
    "rendered grasp_occlusion": f"{_OPENING} until it is learnt. {_TEXTURE}.",
    "rendered jaw_cycle": f"{_OPENING}. {_TEXTURE}.",
    "rendered bump_y": f"{_OPENING} until it is learnt. One standing background is one draw of a common error.",
    "rendered series2": (
        f"{_OPENING} until it is learnt. Every second frame is a jump, so that every transform is "
        f"`suspect` for a frame."
    ),
    "rendered clean, true jaw": "0.01 to 0.02 px of bias by the phase of the pixels is left; ten frames.",
    "rendered static_background, true jaw": f"{_TEXTURE}.",
    "rendered grasp_occlusion, true jaw": f"Fewer edges are left. {_TEXTURE}.",
    "rendered jaw_cycle, true jaw": f"{_TEXTURE}.",
    "rendered bump_y, true jaw": "One standing background is one draw of a common error.",
    "rendered series2, true jaw": "Every second frame is a jump, so that every transform is `suspect` for a frame.",
}
