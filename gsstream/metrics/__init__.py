"""What is measured on decoded frames. Numpy only."""

from gsstream.metrics.flip import FLIP_VARIANT as FLIP_VARIANT
from gsstream.metrics.flip import flip as flip
from gsstream.metrics.lpips import OnnxLpips as OnnxLpips
from gsstream.metrics.moving import changed_mask as changed_mask
from gsstream.metrics.moving import flicker as flicker
from gsstream.metrics.moving import moving_mask as moving_mask
from gsstream.metrics.moving import psnr_moving as psnr_moving
from gsstream.metrics.noise import noise_sigma as noise_sigma
from gsstream.metrics.picture_quality import MS_SSIM_VARIANT as MS_SSIM_VARIANT
from gsstream.metrics.picture_quality import SSIM_VARIANT as SSIM_VARIANT
from gsstream.metrics.picture_quality import ms_ssim as ms_ssim
from gsstream.metrics.picture_quality import picture_quality as picture_quality
from gsstream.metrics.picture_quality import psnr as psnr
from gsstream.metrics.picture_quality import ssim as ssim
from gsstream.metrics.trend import peak_memory_mb as peak_memory_mb
from gsstream.metrics.trend import slope_per_100 as slope_per_100
