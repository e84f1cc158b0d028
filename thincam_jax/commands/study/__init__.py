"""A configured study: captures, reconstructions, metrics and a report."""

from thincam_jax.commands.study.build import build_camera as build_camera
from thincam_jax.commands.study.build import build_plane as build_plane
from thincam_jax.commands.study.build import build_reconstructor as build_reconstructor
from thincam_jax.commands.study.check import check_study as check_study
from thincam_jax.commands.study.response import Response as Response
from thincam_jax.commands.study.response import method_response as method_response
