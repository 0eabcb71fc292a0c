# CPU: docker build -t mapg-jax . && docker run --rm -v "$PWD/runs:/data/runs" mapg-jax train --env hopper --heads 10
# CUDA: docker build --build-arg EXTRA='jax[cuda13]' … && docker run --gpus all …
FROM python:3.12-slim-bookworm
RUN apt-get update \
    && apt-get install -y --no-install-recommends libosmesa6 \
    && rm -rf /var/lib/apt/lists/*
# MuJoCo's pictures, without a display.
ENV MUJOCO_GL=osmesa
ARG EXTRA=""
WORKDIR /opt/mapg-jax
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY mapg_jax mapg_jax
COPY envs envs
COPY experiments experiments
RUN pip install --no-cache-dir --constraint constraints.txt . ${EXTRA}
WORKDIR /data
ENTRYPOINT ["mapg"]
CMD ["--help"]
