"""Recipe: a run described as data. Unknown keys are refused; every field says its unit and range.

Defaults here are those of the dense baseline; methods ship their own recipe files (``gsstream methods NAME``).
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from gsstream.input.recordings.options import DataOptions
from gsstream.recipe.budget import Budget

SCHEMA_VERSION = "2.0"
#: Sections of a recipe that do not influence frame 0. A section that is not listed counts as one that does.
LATER_KEYS = (
    "schema_version", "method", "seed", "frames", "confidence", "propagation", "gate", "regularizer", "update",
    "streaming_method", "stream", "motion", "growth",
)  # fmt: skip


#: One channel of a colour.
Channel = Annotated[float, Field(ge=0, le=1)]


class Section(BaseModel):
    """Base of every recipe section: frozen, unknown keys refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True)


class ComponentRef(Section):
    """A part by name, with its parameters (validated against the part's own Config when the run is assembled)."""

    name: str = Field(description="name of a registered part")
    params: dict[str, Any] = Field(default_factory=dict, description="the part's own settings")


class FirstFrame(Section):
    """Seeding and root optimisation of frame 0."""

    epochs: int = Field(default=250, ge=0, description="passes over the training cameras (paper: 250)")
    max_iterations: int = Field(default=2000, ge=0, description="upper bound on epochs * cameras (released code: 4000)")
    sh_degree: int = Field(default=2, ge=0, le=3, description="degree of the spherical harmonics (paper's code: 2)")
    points: Literal["auto", "recording", "sparse", "sfm", "sweep"] = Field(
        default="auto",
        description="auto: the recording's points, else sweep; sparse: the recording's thinned set; "
        "sfm: triangulation; sweep: points that several views agree on (plane sweep)",
    )
    max_points: int = Field(default=12_000, ge=1, description="points kept before the structure seeds anchors")
    lr_means: float = Field(
        default=1.6e-4,
        ge=0,
        description="learning rate of centres, fraction of the rig's extent; a hundredth of it at the last iteration",
    )
    coarse_to_fine: bool = Field(
        default=True,
        description="fit pictures of a quarter and a half of the size first, where those are at least 320 pixels wide; "
        "it takes six to seven tenths of the iterations",
    )
    noise: float = Field(
        default=0.0,
        ge=0,
        le=0.1,
        description="standard deviation of noise on every centre, drawn anew in every iteration, fraction of the rig's "
        "extent (HiCoM): Gaussians that few cameras see fit them less closely",
    )
    few_cameras: bool = Field(
        default=True,
        description="help few cameras, which cannot tell a surface from a cloud that is right from one of them: with "
        "at most 8, leave a fifth of the Gaussians out of every iteration; with 6 to 8 around a room and up to 5 "
        "elsewhere, keep inverse depth smooth where the training image has no edge",
    )
    lr_factor: float = Field(
        default=2.0,
        gt=0,
        le=100,
        description="factor on 3DGS's learning rates of everything but the centres, which are meant for 30,000 "
        "iterations: in fewer, Gaussians that grow into place faster leave less for added ones to fill; 1: as there",
    )
    max_gaussians: int = Field(default=200_000, ge=1, description="upper bound on the number of Gaussians")
    prune_error: float = Field(
        default=10.0,
        ge=0,
        description="a Gaussian goes, when growth has ended, whose absence changes all training images by less than "
        "this many mean squared errors of one channel of a pixel; 0: none goes",
    )
    shell: bool = Field(
        default=True,
        description="large seeds on a sphere around what the cameras look at, so that walls, floor and sky have a "
        "place behind the scene; later frames leave them as they are",
    )
    exposure: bool = Field(
        default=False, description="fit an affine colour map per training camera while optimising frame 0"
    )


class Stream(Section):
    """Every later frame."""

    epochs: int = Field(default=20, ge=1, description="passes over the training cameras per frame (fast: 10, edge: 6)")
    lr_final_factor: float = Field(
        default=1.0,
        gt=0,
        le=1,
        description="factor on the learning rates of residuals at the last iteration of a frame, log-linear from 1 at "
        "the first; the rate of gates stays",
    )
    active_threshold: float = Field(
        default=0.0, ge=0, le=1, description="rows whose gate opens with at most this probability are left out"
    )
    change_threshold: float = Field(
        default=0.0,
        ge=0,
        le=100,
        description="tiles whose pixels differ from the last frame, or the one before, by more than this many sigmas "
        "of their own spread count as changed; only Gaussians visible in them take part, and only until their gate has "
        "closed. 0: everything takes part to the end",
    )
    rd_lambda: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="weight in the loss of the residual's estimated bits per pixel of one view; 0: none",
    )
    light: float = Field(
        default=0.0,
        ge=0,
        le=100,
        description="grey levels of 255 by which a third of what stands still must have drifted since its colours last "
        "followed the light; then all colours that stand still are compared with the images. A camera that drifts so "
        "far from most others gets a gain of its own, a lamp that is switched a factor for the whole scene. 0: none",
    )
    refine_frames: int = Field(
        default=0,
        ge=0,
        description="later frames in each of which a first frame that was made in few iterations goes on being "
        "optimised, beside the stream; then a key packet brings the result. 0: none. For live recordings",
    )
    refine_iterations: int = Field(
        default=0, ge=0, description="iterations that each of these frames gives to it; 0 where refine_frames is 0"
    )
    on_error: Literal["raise", "repeat"] = Field(
        default="raise",
        description="when a part fails in a later frame; raise: the run ends, the stream holds every frame before it; "
        "repeat: the frame changes nothing, which a warning and its metrics say",
    )
    progressive: bool = Field(default=False, description="activate octree levels from floor(H/2) on (paper)")

    @model_validator(mode="after")
    def _refines_in_frames_and_iterations(self) -> Stream:
        if (self.refine_frames > 0) != (self.refine_iterations > 0):
            raise ValueError(
                "expected refine_frames and refine_iterations both 0 or both above 0, got "
                f"{self.refine_frames} and {self.refine_iterations}; set both, as --recipe recording:live does"
            )
        return self


class Codec(Section):
    """How packets are written."""

    key_interval: int = Field(
        default=0, ge=0, description="most frames from one key packet to the next, which replaces a delta; 0: no period"
    )
    trim: float = Field(
        default=0.0,
        ge=0,
        lt=1,
        description="share of each delta packet's bytes given up, the symbols and gates that explain least per bit; "
        "not read under a budget of size, which trims as far as it must",
    )
    key_rd_lambda: float = Field(
        default=0.1,
        ge=0,
        description="squared error that a bit of frame 0 must save, in mean squared errors of one channel of a "
        "training image's pixel; 0: every value is rounded to the nearest",
    )
    first_layer: float = Field(
        default=0.5,
        gt=0,
        le=1,
        description="share of frame 0's Gaussians that stand first in its packet, those that the training images would "
        "miss most: players draw them while the rest is on its way; 1: all stand together",
    )


class Recipe(Section):
    """Everything that decides the bytes of a run, besides the recording itself."""

    schema_version: Literal["2.0"] = Field(default="2.0", description="version of this schema")
    method: str = Field(default="dense", description="name of the method this recipe belongs to")
    seed: int = Field(default=0, ge=0, description="seed of every random stream")
    structure: ComponentRef = Field(default=ComponentRef(name="flat"), description="how Gaussians are grouped")
    confidence: ComponentRef = Field(default=ComponentRef(name="uniform"), description="which Gaussians changed")
    propagation: ComponentRef = Field(default=ComponentRef(name="group-max"), description="how belief spreads to nodes")
    gate: ComponentRef = Field(default=ComponentRef(name="always-open"), description="which nodes may move")
    motion: ComponentRef = Field(default=ComponentRef(name="still"), description="what moves before the residual")
    regularizer: ComponentRef = Field(default=ComponentRef(name="none"), description="what openness costs")
    update: ComponentRef = Field(default=ComponentRef(name="additive"), description="how a gated change is applied")
    growth: ComponentRef = Field(default=ComponentRef(name="none"), description="which Gaussians are added and removed")
    streaming_method: ComponentRef = Field(
        default=ComponentRef(name="parts"),
        description="what goes from frame to frame; parts: the slots above; other methods bring their own",
    )
    renderer: ComponentRef = Field(
        default=ComponentRef(name="auto"), description="auto: the fastest that works here, else the reference"
    )
    first_frame: FirstFrame = Field(default=FirstFrame(), description="frame 0")
    stream: Stream = Field(default=Stream(), description="later frames")
    codec: Codec = Field(default=Codec(), description="packets")
    budget: Budget = Field(default=Budget(), description="what a frame may cost; nothing given: no limits")
    data: DataOptions = Field(default=DataOptions(), description="the split, and what is done about bad images")
    background: Literal["auto"] | tuple[Channel, Channel, Channel] = Field(
        default="auto",
        description="colour behind everything, red, green, blue from 0 to 1; auto: the mean of the training images of "
        "frame 0, so that a ray which no surface stops needs nothing invented on it",
    )
    scale: float = Field(default=1.0, gt=0, le=1, description="images are downscaled by this factor on reading")
    frames: int | None = Field(default=None, ge=1, description="number of frames to process; all when absent")
    near: float = Field(
        default=0.01, gt=0, lt=1, description="near plane, fraction of the rig's extent; nothing closer is drawn"
    )


def first_frame_settings(recipe: Recipe) -> dict[str, Any]:
    """Return the settings that frame 0 depends on, besides the seed: two recipes that agree in them make the same."""
    values = recipe.model_dump(mode="json", exclude=set(LATER_KEYS))
    for section, names in (("budget", ("memory",)), ("codec", ("key_rd_lambda", "first_layer"))):
        values[section] = {name: values[section][name] for name in names}  # all that frame 0 knows of the section
    return values
