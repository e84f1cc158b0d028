"""The cheapest model that is accurate enough, found from one-dimensional fields."""

from thincam_jax.lensless.accuracy.select import predict_error as predict_error
from thincam_jax.lensless.accuracy.select import select_model as select_model
