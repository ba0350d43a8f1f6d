"""Overlay of exported pages and pictures: title, legend and counts; beside them card, plots over time and gallery.

viser leaves its panels out of exported pages, so these are plain HTML. They say what is drawn, not what the player's
slider stands at: each frame moves a node of the scene to its number, and they read it there. Where a later viser has no
such place, the counts of the first frame stay. Legend and card fold, and lie beside or, where that is too narrow, below
each other.
"""

import json
import re
from dataclasses import dataclass
from html import escape

from dsrc.review.page.browser import HONEST_COLORS, NOTICE
from dsrc.review.page.cameras import CameraPose

SHOWN = "/shown"
"""Node of the scene whose x, m, is the number of the drawn frame, from 1: a player that goes back sets it to 0."""

STOP = """
(()=>{const slider=document.querySelector('[role=slider]');
if(window.__VISER_EMBED_DATA__&&slider)
 slider.dispatchEvent(new KeyboardEvent('keydown',{key:'Home',bubbles:true,cancelable:true}));})()
"""
"""Pause the player of an exported page and go back to its first frame."""

ROOMY_PX = 900
"""Width of a page or cell below which legend and card are folded at first, px: open they cover most of it."""

_CSS = """
#review-panels{position:absolute;z-index:5;inset:14px 16px 96px;display:flex;justify-content:space-between;
 align-items:flex-start;gap:8px;pointer-events:none}
#review,#review-side{padding:14px 16px 12px;box-sizing:border-box;max-height:100%;overflow:auto;pointer-events:auto;
 font:13px/1.45 system-ui,"Segoe UI",Roboto,"DejaVu Sans",sans-serif;color:#dbe3ee;background:rgba(13,16,23,.88);
 border:1px solid rgba(148,163,184,.20);border-radius:10px;user-select:none}
#review{max-width:330px}
#review-side[open]{flex:0 1 330px}
@media (max-width:499px){#review-panels{flex-direction:column;align-items:stretch}
 #review,#review-side[open]{flex:0 1 auto;max-width:none}}
#review summary,#review-side summary{cursor:pointer}
#review>summary,#review-side>summary{list-style:none}
#review>summary::before,#review-side>summary::after{content:"\\25be";float:right;margin-left:8px;font-size:13px}
#review[open]>summary::before,#review-side[open]>summary::after{content:"\\25b4"}
#review-side[open]>summary{float:right;font-size:0}
#review[open] #review-counts,.still>*>summary::before,.still>#review-side>summary{display:none}
#review-panels.still{bottom:auto}
#review-panels.still>*{max-height:none;max-width:330px;overflow:hidden}
#review-side p{margin:0 0 .5em!important;font-size:13px!important}
#review table,#review-side table{margin:0!important;font-size:12px!important}
#review-side svg{cursor:default!important;margin-top:6px}
#review-side details summary{margin-top:8px}
#review h1{margin:0 0 1px;font-size:15px;font-weight:650;color:#fff;letter-spacing:.01em}
#review>summary span{display:block;color:#93a1b5;font-size:12px}
#review .review p{margin:0!important;font-size:12px!important;color:#93a1b5}
#review .review ul{margin-top:8px;padding:8px 0 0;max-height:none;font-size:13px;
 border-top:1px solid rgba(148,163,184,.18)}
#review .review b{color:#fff}
#review nav{display:flex;gap:6px;margin-top:10px}
#review button{flex:1;padding:4px 0;font:inherit;font-size:12px;color:#cbd5e1;cursor:pointer;border-radius:6px;
 background:rgba(148,163,184,.12);border:1px solid rgba(148,163,184,.22)}
#review button:hover{background:rgba(148,163,184,.28);color:#fff}
"""

_JS = (
    """
(()=>{const d=window.__REVIEW__,$=i=>document.getElementById(i);let last=0;
const show=k=>{if(k===last)return;last=k;const f=d.frames[k];
 for(const n in f){const e=$('review-'+n);if(e)e.innerHTML=f[n];}};
const tick=()=>{const m=window.__viserMutable,p=m&&m.nodePoseData['__SHOWN__'],k=p?Math.round(p.position[0])-1:-1;
 if(d.frames[k])show(k);};
setInterval(tick,50);
for(const one of document.querySelectorAll('#review-panels>details'))one.open=innerWidth>=__ROOMY__;
const still=d.stop&&setInterval(()=>{if(document.querySelector('[role=slider]')){clearInterval(still);__STOP__}},50);
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
    .replace("__STOP__", STOP)
    .replace("__ROOMY__", str(ROOMY_PX))
)

_CELLS = """<!doctype html><html><head><meta charset="utf-8"><title>Review: side by side</title><style>
html,body{margin:0;height:100%;background:#0a0c11;overflow:hidden}
main{display:grid;height:100%;gap:2px;grid-template-columns:1fr 1fr;grid-auto-rows:1fr}
iframe{width:100%;height:100%;border:0}
</style></head><body><main></main><script>
const [before,after,cells]=__PAGES__;let leads=null;
const frames=cells.map((own,number)=>{const frame=document.createElement('iframe');frame.id='cell'+number;
 frame.srcdoc=before+own[0]+after+own[1];document.querySelector('main').append(frame);
 for(const kind of ['pointerenter','focusin'])frame.addEventListener(kind,()=>{leads=frame;});return frame;});
setInterval(()=>{const of=frame=>frame.contentWindow.__viserMutable?.cameraControl,from=leads&&of(leads);
 if(from)for(const frame of frames)if(frame!==leads&&of(frame))of(frame).fromJSON(from.toJSON(),false);},50);
</script></body></html>"""


@dataclass(frozen=True, slots=True)
class CameraButton:
    """Camera button: name, key and pose in the review frame."""

    name: str
    key: str
    pose: CameraPose


def overlay(texts: list[dict[str, str]], title: str, cameras: list[CameraButton], gallery: str = "") -> str:
    """HTML of the overlay with the texts of the first frame.

    Args:
        texts: HTML of every frame by its place: on the left `subtitle`, `summary` and, for its folded state,
            `counts`; on the right `card` and `plots`.
        gallery: HTML of the pictures of the errors, "" for none.
    """

    def own(name: str, element: str) -> str:
        return f'<{element} id="review-{name}">{texts[0].get(name, "")}</{element}>'

    buttons = "".join(
        f'<button data-camera="{c.name}" data-key="{c.key}" title="key {c.key}">{c.name}</button>' for c in cameras
    )
    side = "".join(own(name, "div") for name in ("card", "plots") if any(one.get(name) for one in texts))
    side += f"<details><summary>Errors by cause</summary>{gallery}</details>" if gallery else ""
    head = f"<h1>{escape(title)}</h1>{own('subtitle', 'span')}{own('counts', 'span')}"
    return (
        f'<style>{_CSS}</style><div id="review-panels">'
        f'<details id="review" open><summary>{head}</summary>{own("summary", "div")}'
        f"{f'<nav>{buttons}</nav>' if buttons else ''}</details>"
        + (f'<details id="review-side" open><summary>Card and plots</summary>{side}</details>' if side else "")
        + "</div>"
    )


def overlay_script(texts: list[dict[str, str]], cameras: list[CameraButton], stop: bool) -> str:
    """Script element that keeps the overlay in step with the player.

    Args:
        stop: stand at the first frame until the player is started.
    """
    names = dict.fromkeys((name for one in texts for name in one), "")
    data = {
        "frames": [names | one for one in texts],
        "cameras": {camera.name: [*camera.pose.position.tolist(), *camera.pose.look_at.tolist()] for camera in cameras},
        "stop": stop,
    }
    return f"<script>window.__REVIEW__={script_json(data)};{_JS}{HONEST_COLORS}{NOTICE}</script>"


def script_json(data: object) -> str:
    """JSON that may stand in a script element: `</` in a drive's name would end it."""
    return json.dumps(data, separators=(",", ":")).replace("</", "<\\/").replace("<!--", "<\\u0021--")


def cells_html(pages: list[tuple[str, str]]) -> str:
    """HTML of up to four pages with one camera.

    Args:
        pages: page of the player and overlay of each cell.
    """
    data = re.compile(r'(?<=__VISER_EMBED_DATA__=")[^"]*')
    before, after = data.split(pages[0][0], maxsplit=1)
    cells = [[*data.findall(page), body] for page, body in pages]
    return _CELLS.replace("__PAGES__", script_json([before, after[: after.rindex("</body>")], cells]))


def page_html(page: str, body: str, title: str) -> str:
    """HTML of a player's page with an overlay."""
    head, end = page.index("</head>"), page.rindex("</body>")
    return f"{page[:head]}<title>{escape(title)}</title>{page[head:end]}{body}{page[end:]}"
