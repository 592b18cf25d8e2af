"""Networks: frame encoders, the recurrent encoder, prediction heads and action targets."""

from vd4rl_pomdp.nn.encoder import Encoder, EncoderCard, EncoderConfig, StreamState
from vd4rl_pomdp.nn.encoder_folder import load_encoder, save_encoder

__all__ = ["Encoder", "EncoderCard", "EncoderConfig", "StreamState", "load_encoder", "save_encoder"]
