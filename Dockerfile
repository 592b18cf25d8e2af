# Debian, software rendering, no GPU: `docker build -t vd4rl-pomdp .`, whose last step runs every stage once.
# `--build-arg PIP_EXTRA_INDEX_URL=...`, PyTorch's index of builds for CPUs, saves the 4 GB of its libraries for GPUs.
# The wheel is built from the checkout, so that every run of the image names its commit.
# `docker run --rm -v "$PWD:/study" vd4rl-pomdp demo` writes into the present folder.
FROM debian:bookworm-slim AS build
RUN apt-get update && apt-get install -y --no-install-recommends git python3-pip
COPY . /source
RUN pip wheel --no-deps --wheel-dir /wheels /source

FROM debian:bookworm-slim
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3 python3-venv libegl1 libgl1 libgl1-mesa-dri \
    && rm -rf /var/lib/apt/lists/* \
    && python3 -m venv /opt/venv
ENV PATH=/opt/venv/bin:$PATH MUJOCO_GL=egl LP_NUM_THREADS=1
ARG PIP_EXTRA_INDEX_URL
COPY --from=build /wheels /source/constraints.txt /opt/
RUN pip install --no-cache-dir -c /opt/constraints.txt "$(echo /opt/*.whl)[navigation]"
WORKDIR /study
RUN vd4rl-pomdp demo --preset smoke --out smoke && rm -r smoke
ENTRYPOINT ["vd4rl-pomdp"]
