"""Overlay of an exported page: title, legend, counts of the playing frame, camera buttons.

viser leaves its panels out of exported pages, so these are plain HTML. They say what is drawn, not what the player's
slider stands at: each frame moves a node of the scene to its number, and they read it there. Where a later viser has no
such place, the counts of the first frame stay.
"""

import json
from dataclasses import dataclass
from html import escape

from dsrc.review.page.browser import HONEST_COLORS
from dsrc.review.page.cameras import CameraPose
from dsrc.review.palette import Rgb, css
from dsrc.review.texts import box_legend, fate_legend, scale_bar
from dsrc.review.view import OTHER_TRUTH, FrameView

SHOWN = "/shown"
"""Node of the scene whose x, m, is the number of the drawn frame, from 1: a player that goes back sets it to 0."""

_CSS = """
#review{position:fixed;z-index:5;left:16px;top:14px;max-width:min(330px,80vw);padding:14px 16px 12px;
 font:13px/1.45 system-ui,"Segoe UI",Roboto,"DejaVu Sans",sans-serif;color:#dbe3ee;background:rgba(13,16,23,.80);
 border:1px solid rgba(148,163,184,.20);border-radius:10px;backdrop-filter:blur(6px);user-select:none}
#review h1{margin:0 0 1px;font-size:15px;font-weight:650;color:#fff;letter-spacing:.01em}
#review p{margin:0;color:#93a1b5;font-size:12px}
#review ul{list-style:none;margin:9px 0 0;padding:8px 0 0;border-top:1px solid rgba(148,163,184,.18)}
#review li{display:flex;align-items:center;gap:9px;padding:1.5px 0}
#review i{flex:none;width:10px;height:10px;border-radius:50%}
#review i.box{width:11px;height:11px;border-radius:2px;background:none;border:2px solid}
#review i.dash{border-style:dashed}
#review b{margin-left:auto;padding-left:16px;font-weight:600;color:#fff;font-variant-numeric:tabular-nums}
#review small{margin-left:auto;padding-left:16px;color:#7c8aa0;font-size:11.5px;font-variant-numeric:tabular-nums}
#review nav{display:flex;gap:6px;margin-top:10px}
#review button{flex:1;padding:4px 0;font:inherit;font-size:12px;color:#cbd5e1;cursor:pointer;border-radius:6px;
 background:rgba(148,163,184,.12);border:1px solid rgba(148,163,184,.22)}
#review button:hover{background:rgba(148,163,184,.28);color:#fff}
"""

_JS = """
(()=>{const d=window.__REVIEW__,$=i=>document.getElementById(i);let last=-1;
const show=k=>{if(k===last)return;last=k;const f=d.frames[k];
 for(const n in f){const e=$('review-'+n);if(e)e.textContent=f[n];}};
const tick=()=>{const m=window.__viserMutable,p=m&&m.nodePoseData['__SHOWN__'],k=p?Math.round(p.position[0])-1:-1;
 if(d.frames[k])show(k);};
show(0);setInterval(tick,50);
const turn=([w,x,y,z],[a,b,c])=>{const u=2*(y*c-z*b),v=2*(z*a-x*c),t=2*(x*b-y*a);
 return[a+w*u+y*t-z*v,b+w*v+z*u-x*t,c+w*t+x*v-y*u];};
for(const b of document.querySelectorAll('#review button'))b.onclick=()=>{
 const m=window.__viserMutable,p=d.cameras[b.dataset.camera];if(!m||!m.cameraControl||!p)return;
 const q=m.nodePoseData[''].wxyz;
 m.cameraControl.setLookAt(...turn(q,p.slice(0,3)),...turn(q,p.slice(3)),true);};
window.addEventListener('keydown',e=>{const b=document.querySelector('#review button[data-key="'+e.key+'"]');
 if(b&&!/INPUT|TEXTAREA/.test(document.activeElement.tagName))b.click();});
})();
""".replace("__SHOWN__", SHOWN)


@dataclass(frozen=True, slots=True)
class CameraButton:
    """Camera button: name, key and pose in the review frame."""

    name: str
    key: str
    pose: CameraPose


def frame_texts(view: FrameView, subtitle: str) -> dict[str, str]:
    """Texts of the legend that change with the frame, by id."""
    texts = {"subtitle": subtitle, "time": f"frame {view.index} · {view.time_s:.1f} s"}
    texts |= {f"points-{one.agent_id}": f"{one.total // 1000}k points" for one in view.agents if one.total >= 1000}
    other = len(view.layers[OTHER_TRUTH])
    if view.help is not None:
        found, made = (sum(map(len, boxes)) for boxes in (view.help.found, view.help.made))
        counted = {"found": found, "made": made, "harmed": len(view.help.harmed), "missed": len(view.help.missed)}
        return texts | {name: str(count) for name, count in counted.items()} | {"other": str(other)}
    if not view.labelled:
        return {**texts, "detected": str(view.detected)}
    if view.counts is None:
        return {**texts, "objects": str(len(view.truth) - other), "other": str(other)}
    counts = view.counts
    share = [("precision", counts.precision), ("recall", counts.recall)]
    texts |= {"tp": str(counts.tp), "fp": str(counts.fp), "fn": str(counts.fn)}
    return texts | {name: "–" if value is None else f"{value:.2f}" for name, value in share}


def add_overlay(html: str, texts: list[dict[str, str]], views: list[FrameView], cameras: list[CameraButton]) -> str:
    """Put the overlay into an exported page.

    Args:
        texts: `frame_texts` of every frame.
        views: all frames: a row for every agent and every kind of box of any of them.
    """
    first, names = views[0], dict.fromkeys((name for one in texts for name in one), "")
    title, rows = first.drive, {agent.agent_id: agent for view in views for agent in view.agents}
    data = {
        "frames": [names | one for one in texts],
        "cameras": {camera.name: [*camera.pose.position.tolist(), *camera.pose.look_at.tolist()] for camera in cameras},
    }
    # `</` in a drive's name would end the script element.
    packed = json.dumps(data, separators=(",", ":")).replace("</", "<\\/")
    agents = "".join(
        _row(agent.rgb, "", escape(f"{agent.title}{' · ego' if agent.is_ego else ''}"),
             f'<small id="review-points-{agent.agent_id}"></small>')
        for agent in rows.values()
    )  # fmt: skip
    if bar := scale_bar(first.color_by):
        agents += f'<li style="display:block;margin-top:6px">{bar}</li>'
    if fates := fate_legend(first):
        agents += "</ul><ul>" + "".join(_row(rgb, "", text, "") for rgb, text in fates)
    boxes = "".join(
        _row(rgb, "box dash" if text.endswith("dashed") else "box", text, f'<b id="review-{name}"></b>')
        for rgb, text, name in dict.fromkeys(row for view in views for row in box_legend(view))
        if name
    )
    boxes += "".join(f'<li>{name}<b id="review-{name}"></b></li>' for name in ("precision", "recall") if name in names)
    buttons = "".join(
        f'<button data-camera="{c.name}" data-key="{c.key}" title="key {c.key}">{c.name}</button>' for c in cameras
    )
    body = (
        f'<style>{_CSS}</style><div id="review"><h1>{escape(title)}</h1><p id="review-subtitle"></p>'
        f'<p id="review-time"></p><ul>{agents}</ul><ul>{boxes}</ul><nav>{buttons}</nav></div>'
        f"<script>window.__REVIEW__={packed};{_JS}{HONEST_COLORS}</script>"
    )
    head = html.index("</head>")
    html = html[:head] + f"<title>{escape(title)}</title>" + html[head:]
    end = html.rindex("</body>")
    return html[:end] + body + html[end:]


def _row(rgb: Rgb, kind: str, label: str, end: str) -> str:
    style = f"{'border-color' if kind else 'background'}:{css(rgb)}"
    return f'<li><i class="{kind}" style="{style}"></i>{label}{end}</li>'
