# AMVNet as a command, with its built-in weights:
#   docker build --tag amvnet .
#   docker build --tag amvnet:cuda --build-arg DEVICE=cuda .
#   docker run --rm --volume "$PWD:/data" --user "$(id -u):$(id -g)" amvnet predict scan.bin --weights sim-hdl64e --out labels
ARG PYTHON=3.12.13-slim-bookworm

FROM python:${PYTHON} AS build
ARG DEVICE=cpu
RUN python -m venv /opt/amvnet
ENV PATH=/opt/amvnet/bin:$PATH
WORKDIR /build
COPY constraints.txt docker/requirements.txt ./

# Install torch first and alone, as the Makefile does. PyPI's wheels bring CUDA. Builds for the CPU are
# in another index; pip prefers them, because the suffix +cpu makes the same version newer.
RUN case "$DEVICE" in \
      cpu) export PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu ;; \
      cuda) ;; \
      *) echo "DEVICE: expected cpu or cuda, found $DEVICE" >&2; exit 2 ;; \
    esac \
    && pip install --no-cache-dir --constraint constraints.txt --constraint requirements.txt torch
RUN pip install --no-cache-dir --constraint constraints.txt --requirement requirements.txt

# Install the package last, so that a change of its code repeats only this step.
COPY LICENSE README.md pyproject.toml ./
COPY src src
RUN pip install --no-cache-dir --no-deps --no-build-isolation . && pip check

FROM python:${PYTHON}
LABEL org.opencontainers.image.title="AMVNet" \
      org.opencontainers.image.description="LiDAR semantic segmentation by late fusion of two views" \
      org.opencontainers.image.licenses="Apache-2.0"
RUN useradd --uid 1000 --create-home --no-log-init amvnet \
    && install --directory --owner amvnet --group amvnet /data
COPY --from=build /opt/amvnet /opt/amvnet

# The caches lie where any user can write. The last two variables let NVIDIA's container runtime pass a
# GPU to the container.
ENV PATH=/opt/amvnet/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    MPLCONFIGDIR=/tmp/matplotlib \
    AMVNET_CACHE=/tmp/amvnet \
    NVIDIA_VISIBLE_DEVICES=all \
    NVIDIA_DRIVER_CAPABILITIES=compute,utility
USER 1000
WORKDIR /data
ENTRYPOINT ["amvnet"]
CMD ["--help"]
